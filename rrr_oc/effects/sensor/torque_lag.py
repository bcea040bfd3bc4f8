"""A joint's torque that is recorded late, or early, as every log's is by some milliseconds."""

from rrr_oc.effects.base import Prior
from rrr_oc.effects.sensor.time_delay import TimeDelay
from rrr_oc.robot.parameters import Parameter


class TorqueLag(TimeDelay):
    """recorded torque(t) = true torque(t − delay), of one joint, with either sign.

    A filter of the first order with a time constant is, for motions that are slow beside it, a delay of that time. A torque that is held
    over a cycle and recorded at its beginning is half a cycle early.
    """

    name = "torque_lag"
    equation = "recorded torque(t) = true torque(t - delay), of one joint"
    plain = "The recorded torque of {joints} lags the recorded motion by {delay:ms}."
    parameters = (Parameter("delay", "s", 0.0, lower=-0.02, upper=0.05),)
    role = "plain"
    scope = "everywhere"
    placement = "joint"
    prior = Prior(1.0, {"delay": (0.003, "")}, "cycles of field buses, held torques and filters of currents: some ms")
