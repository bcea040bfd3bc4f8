"""A pendulum of two servos: 12 bit, rows that come in batches or are lost, stamps that jitter."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace


def chain(r) -> Chain:
    batches = bool(r.integers(2))
    return Chain(
        rate=float(r.choice([80, 100, 125])),
        bits=12,
        position_noise=3e-4,
        torque_late=r.uniform(0, 0.012),
        torque_noise=r.uniform(0.01, 0.03),
        torque_step=r.uniform(0.005, 0.02),
        jitter=0.0 if batches else r.uniform(0.001, 0.004),
        dropped=r.uniform(0.0, 0.03),
        batch=int(r.integers(2, 4)) if batches else 1,
    )


FAMILY = Family(
    says="two hanging servos, encoders of 12 bit, rows in batches or lost, stamps jitter, torque in steps",
    arm=ArmKind("yy", (0.16, 0.12), (0.4, 0.25), dry=(0.1, 0.25), viscous=(0.05, 0.15), rotor=(0.5, 2), hangs=True, width=0.02),
    chain=chain,
    pace=Pace(15, 3.0, 1.3, 0.15),
    recordings=4,
)
