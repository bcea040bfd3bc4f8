"""A leg of three joints: it hangs, is fast and has little friction; now and then somebody pushes it."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace
from validation.chains.plant import Control

FAMILY = Family(
    says="a hanging leg of three joints, up to 8 rad/s, little friction, 500 Hz, pushed now and then",
    arm=ArmKind(
        "xyy",
        (0.12, 0.22),
        (1.2, 0.3),
        dry=(0.01, 0.05),
        viscous=(0.003, 0.015),
        rotor=(0.1, 0.5),
        acceleration=25,
        hangs=True,
        width=0.0,
    ),
    chain=lambda r: Chain(
        rate=500,
        bits=14,
        speed="filtered",
        speed_cutoff=r.uniform(40, 100),
        torque_late=r.uniform(0, 0.004),
        torque_noise=0.015,
    ),
    pace=Pace(8, 8.0, 0.9, 0.5),
    control=Control(1000, bandwidth=40, bits=14, cutoff=100, gravity=0.5),
    pushes=1.5,
)
