"""Four joints: currents with a ripple stand for torques, and the column of the speed is a difference with a wrong scale."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace

FAMILY = Family(
    says="four joints, currents with ripple and noise, dq a difference of rows 3 to 10 % too small or large, 100 to 200 Hz",
    arm=ArmKind("zyyx", (0.3, 0.15), (4, 1), dry=(0.06, 0.18), viscous=(0.05, 0.2), rotor=(0.3, 1.5), width=0.02),
    chain=lambda r: Chain(
        rate=float(r.choice([100, 150, 200])),
        bits=int(r.integers(15, 19)),
        speed="scaled",
        speed_scale=1 + r.uniform(0.03, 0.1) * r.choice([-1, 1]),
        torque_late=r.uniform(0, 0.006),
        torque_noise=r.uniform(0.01, 0.03),
        torque_step=r.uniform(0.001, 0.005),
        ripple=r.uniform(0.01, 0.04),
        ripple_cycles=float(r.integers(200, 600)),
    ),
    pace=Pace(15, 1.6, 1.2, 0.1),
    points=True,
    current=True,
)
