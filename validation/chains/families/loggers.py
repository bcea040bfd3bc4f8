"""Three joints, measured well, and written down by a logger with a fault that nobody told of."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.faults import FAULTS
from validation.chains.motions import Pace

FAMILY = Family(
    says="three joints, encoders of 15 to 19 bit, 100 to 250 Hz, and a fault of the logger that nobody told of",
    arm=ArmKind("zyy", (0.3, 0.2), (3.0, 1.0), dry=(0.05, 0.15), viscous=(0.03, 0.12), rotor=(0.2, 0.8), width=0.015),
    chain=lambda r: Chain(
        rate=float(r.choice([100, 125, 200, 250])),
        bits=int(r.integers(15, 20)),
        position_noise=1e-5,
        torque_late=r.uniform(0.0, 0.008),
        torque_noise=r.uniform(0.005, 0.02),
        fault=r.choice([fault.__name__ for fault in FAULTS]),
    ),
    pace=Pace(15, 1.8, 1.2, 0.12),
)
