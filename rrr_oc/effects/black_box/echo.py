"""A torque that no law of the catalogue explains and that follows from the past of the load, not from the instant."""

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.capabilities import BlackBox, FollowsLoad
from rrr_oc.numerics.oscillator import Oscillator
from rrr_oc.robot.parameters import Parameter

FREQUENCIES = (1.5, 2.0, 2.7, 3.7, 5.0, 6.7, 9.0, 12.0, 16.0, 22.0, 30.0)  # [rad/s], of the trials, from which fits start
DAMPINGS = (0.1, 0.6)  # damping ratios of the trials


class Echo(BlackBox, FollowsLoad):
    """tau = lag (x − tau_l) + swing x'/frequency, x'' + 2 damping frequency x' + frequency² x = frequency² tau_l.

    Any linear second-order response to the load torque that vanishes at rest: a part of the load that moves by itself, such as a
    liquid or a hose, or a part that creeps.
    """

    name = "echo"
    equation = "tau = lag (x - tau_l) + swing dx/dt / frequency, x an oscillator that follows tau_l"
    parameters = (
        Parameter("frequency", "rad/s", 5.0, lower=1.0, upper=60.0, factor=3.0),
        Parameter("damping", "1", 0.1, lower=0.01, upper=3.0),
        Parameter("lag", "1", 0.0, lower=-1.0, upper=1.0),
        Parameter("swing", "1", 0.0, lower=-1.0, upper=1.0),
    )
    amplitudes = ("lag", "swing")
    states = (Parameter("x", "Nm", 0.0), Parameter("v", "Nm/s", 0.0))
    side = "drive"
    inputs = ("load",)
    prior = Prior(
        0.001,
        {"lag": (0.2, ""), "swing": (0.2, "")},
        "what moves by itself is a small part of the load; the catalogue comes first",
    )

    @property
    def depends_on(self):
        return (("load", self.joints[0]), ("time", -1))

    def words(self, theta):
        return f"an echo of the load torque, which rings at {theta['frequency']:.3g} rad/s with a damping of {theta['damping']:.2g}"

    def torque(self, signals, theta, width):
        load = signals.load[self.joints[0]]
        if signals.states is None:
            return (0 * load,)
        x, v = signals.states[0], signals.states[1]
        return (theta["lag"] * (x - load) + theta["swing"] * v / theta["frequency"],)

    def rate(self, signals, theta, width):
        x, v, omega = signals.states[0], signals.states[1], theta["frequency"]
        return v, omega**2 * (signals.load[self.joints[0]] - x) - 2 * theta["damping"] * omega * v

    def rest(self, load):
        return float(load[self.joints[0]]), 0.0

    def course(self, t, load, theta):
        if len(t) < 3:
            return np.array([load, 0 * load])
        one, omega = np.ones(len(t) - 1), theta["frequency"]
        return Oscillator(t, one, omega**2 * one, 2 * theta["damping"] * omega).driven(omega**2 * load, rested=True)[:2]

    @classmethod
    def black_box_trials(cls, view, j, ranges, torque):
        for frequency in FREQUENCIES if torque != "load" else ():  # the recorded load would be its own input
            for damping in DAMPINGS:
                points = tuple({"frequency": frequency, "damping": damping, "lag": lag, "swing": 1 - lag} for lag in (1.0, 0.0))
                yield Trial(cls((j,)), points)
