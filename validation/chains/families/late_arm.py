"""Three joints: the speed passed a causal filter, the torque one of the current loop, and it is late."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace

FAMILY = Family(
    says="three joints, encoders of 16 to 20 bit, dq through 15 to 60 Hz, torque 2 to 15 ms late through 20 to 80 Hz, 100 to 250 Hz",
    arm=ArmKind("zyy", (0.35, 0.22), (3.5, 1.2), dry=(0.05, 0.15), viscous=(0.03, 0.12), rotor=(0.2, 0.8), width=0.015),
    chain=lambda r: Chain(
        rate=float(r.choice([100, 125, 200, 250])),
        bits=int(r.integers(16, 21)),
        position_noise=1e-5,
        speed="filtered",
        speed_cutoff=r.uniform(15, 60),
        torque_late=r.uniform(0.002, 0.015),
        torque_cutoff=r.uniform(20, 80),
        torque_noise=r.uniform(0.01, 0.03),
    ),
    pace=Pace(15, 1.8, 1.2, 0.12),
)
