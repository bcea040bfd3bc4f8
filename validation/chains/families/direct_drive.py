"""Two joints with direct drives: fast, coarse encoders, noisy late torques, in MuJoCo under a PD of its own."""

from validation.chains.arms import ArmKind
from validation.chains.chain import Chain
from validation.chains.families.family import Family
from validation.chains.motions import Pace
from validation.chains.plant import Control

FAMILY = Family(
    says="two direct drives, encoders of 12 to 14 bit, up to 6 rad/s, 500 Hz, dq filtered, noisy late torques, PD at 1 kHz",
    arm=ArmKind(
        "yy", (0.3, 0.25), (1.5, 0.8), dry=(0.01, 0.04), viscous=(0.005, 0.02), rotor=(0.05, 0.2), acceleration=15, width=0.0
    ),
    chain=lambda r: Chain(
        rate=500,
        bits=int(r.integers(12, 15)),
        speed="filtered",
        speed_cutoff=r.uniform(20, 60),
        torque_late=r.uniform(0.001, 0.008),
        torque_cutoff=r.uniform(40, 150),
        torque_noise=r.uniform(0.02, 0.06),
    ),
    pace=Pace(10, 6.0, 1.3, 0.35),
    control=Control(1000, bandwidth=30, bits=16, cutoff=80, gravity=0.0),
)
