"""Drives that report efforts without gravity, or without a share of it."""

from dataclasses import replace

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import OnlyRecorded
from rrr_oc.robot.parameters import Parameter


class MissingGravity(OnlyRecorded):
    """recorded torque = true − share G(q): a driver that compensates gravity may report what it adds to that.

    The same as a record of an arm under (1 − share) times gravity, but that friction which depends on the load feels all of it.
    """

    name = "missing_gravity"
    equation = "recorded torque = true - share G(q)"
    plain = "The recorded torques leave out {share:%} of what gravity asks for."
    parameters = (Parameter("share", "1", 0.0, lower=0.0, upper=1.25),)  # with more, the rest would pull upwards
    amplitudes = ("share",)
    placement = "arm"
    alters = "gravity"
    prior = Prior(
        0.01,
        {"share": (1.0, "")},
        "drivers' manuals: some arms report and take efforts beyond their own compensation of gravity",
    )

    def change(self, body, theta):
        return replace(body, gravity=[(1 - theta["share"]) * body.gravity[i] for i in range(3)])
