"""Six axes in MuJoCo: a controller holds torques for 5 ms, dry friction is the engine's constraint."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace
from validation.chains.plant import Control

FAMILY = Family(
    says="six axes in closed loop, torque held for 5 ms and recorded when a hold begins, encoders of 15 bit, 200 Hz",
    arm=ArmKind("zyyxyx", (0.3, 0.12), (6, 1), dry=(0.04, 0.12), viscous=(0.03, 0.1), rotor=(0.2, 0.9), width=0.0),
    chain=lambda r: Chain(rate=200, bits=15, torque_noise=r.uniform(0.0, 0.01), held=0.005),
    pace=Pace(12, 2.0, 1.2, 0.12),
    control=Control(200, bandwidth=22, bits=15, cutoff=50),
)
