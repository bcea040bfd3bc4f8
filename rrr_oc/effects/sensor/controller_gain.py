"""A loop whose gains are not those that the recordings list, where commands are recorded in place of torques."""

import numpy as np

from rrr_oc.effects.base import Prior, Trial
from rrr_oc.effects.capabilities import LoopChange
from rrr_oc.robot.parameters import Parameter

STEP = 1e-4  # of a scale, for the derivatives of trials; doubled, they change by 0.01 %


class ControllerGain(LoopChange):
    """true torque = kp_scale kp (q_d − q) − kd_scale kd dq, of one joint.

    What is recorded is kp (q_d − q) − kd dq. The error q_d − q is what the true torque tau asks for, (tau + kd_scale kd dq) / (kp_scale
    kp), so that the recorded torque is tau / kp_scale + (kd_scale / kp_scale − 1) kd dq. In this form no recorded torque explains itself.
    A loop that brakes more than listed moves as an arm with more viscous friction: kd_scale is its prior's until that friction would be
    below 0.
    """

    name = "controller_gain"
    equation = "true torque = kp_scale kp (q_d - q) - kd_scale kd dq"
    plain = "The loop of {joints} has {kp_scale} times its listed kp, and {kd_scale} times its listed kd."
    parameters = (Parameter("kp_scale", "1", 1.0, lower=0.4, upper=2.5), Parameter("kd_scale", "1", 1.0, lower=0.0, upper=5.0))
    amplitudes = ("kp_scale", "kd_scale")
    scope = "set_up"
    prior = Prior(
        0.05,
        {"kp_scale": (0.2, ""), "kd_scale": (0.3, "")},
        "gains of drives are set in counts: constants of motors and gears turn them into Nm/rad, within 10 to 20 %",
    )

    @property
    def linear(self):
        return False

    def possible(self, theta, payload):
        kp, _ = self.parameters
        return super().possible(theta, payload) and kp.lower < theta["kp_scale"] < kp.upper

    def torque(self, signals, theta, width):
        kp, kd = theta["kp_scale"], theta["kd_scale"]
        more = 1 / kp - 1, kd / kp - 1
        return tuple(more[0] * signals.load[j] + more[1] * signals.braking[j] for j in self.joints)

    def gains(self, kp, kd, theta):
        return theta["kp_scale"] * kp, theta["kd_scale"] * kd

    def trial(self, view, **shape):
        return Trial(self, ({"kp_scale": 1 + STEP, "kd_scale": 1.0}, {"kp_scale": 1.0, "kd_scale": 1 + STEP}), STEP)

    def scales(self, view, trial, prior=None):
        """The coefficients are the scales less 1."""
        return np.array([(prior or self.prior).typical[name][0] for name in self.amplitudes])

    def combined(self, points, coefficients):
        return {name: 1 + float(c) for name, c in zip(self.amplitudes, coefficients, strict=True)}
