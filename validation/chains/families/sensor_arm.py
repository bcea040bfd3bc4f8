"""Seven joints with torque sensors behind the gears, whose zeros drift, and an observer that tells speeds late but without noise."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace

FAMILY = Family(
    says="seven joints, sensors behind the gears (bearings but no rotors) with drift, dq from an observer 3 to 12 ms late, 200 to 500 Hz",
    arm=ArmKind("zyzyzyz", (0.25, 0.1), (4, 0.8), dry=(0.01, 0.04), viscous=(0.005, 0.02), rotor=(0, 0), width=0.02),
    chain=lambda r: Chain(
        rate=float(r.choice([200, 250, 500])),
        bits=19,
        speed="observed",
        speed_late=r.uniform(0.003, 0.012),
        torque_late=r.uniform(0, 0.004),
        torque_noise=r.uniform(0.003, 0.01),
        drift=r.uniform(0.002, 0.01),
    ),
    pace=Pace(12, 1.8, 1.2, 0.12),
)
