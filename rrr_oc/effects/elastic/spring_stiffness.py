"""A listed spring that is stiffer or softer than listed."""

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.capabilities import SpringChange
from rrr_oc.robot.parameters import Parameter


class SpringStiffness(SpringChange):
    """tau = (scale − 1) × torque of the listed spring across the same joints."""

    name = "spring_stiffness"
    equation = "true stiffness = scale x listed"
    plain = "The listed spring of {joints} has {scale} times its listed stiffness."
    parameters = (Parameter("scale", "1", 1.0, lower=0.0),)
    amplitudes = ("scale",)
    prior = Prior(
        0.03, {"scale": (0.2, "")}, "tolerances of coiled springs are 5 to 15 % (DIN EN 15800); their mounts give, too"
    )

    def torque(self, signals, theta, width):
        spring, values, own = signals.springs[self.joints]
        return tuple((theta["scale"] - 1) * tau for tau in spring.torque(signals, values, own))

    def added(self, spring, values, theta):
        return [{**values, **{name: (theta["scale"] - 1) * values[name] for name in spring.amplitudes}}]

    def trial(self, view, **shape):
        return Trial(self, ({"scale": 2.0},))

    def scales(self, view, trial, prior=None):
        """The coefficient is scale − 1."""
        return np.array([(prior or self.prior).typical["scale"][0]])

    def combined(self, points, coefficients):
        return {"scale": 1 + float(coefficients[0])}
