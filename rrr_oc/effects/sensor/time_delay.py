"""A torque channel that lags the position channel."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import math

from rrr_oc.effects.base import Prior
from rrr_oc.effects.capabilities import Delay, ExportTwin
from rrr_oc.robot.parameters import Parameter

SHORTEST = 0.1  # of a file's step: a user may shorten the step as far; with fewer samples kept, the delay would be cut off
LINEAR = 1  # interpolation between samples; MuJoCo's others hold a sample, or overshoot


class TimeDelay(Delay, ExportTwin):
    """recorded torque(t) = true torque(t − delay), for all joints."""

    name = "time_delay"
    equation = "recorded torque(t) = true torque(t - delay)"
    plain = "The recorded torque lags the recorded motion by {delay:ms}."
    parameters = (Parameter("delay", "s", 0.0, lower=0.0),)
    amplitudes = ("delay",)
    scope = "set_up"
    step = 1e-3
    recorded_as = ("motor", "load", "current")  # of commands, `command_delay` is a part of every model
    prior = Prior(0.03, {"delay": (0.005, "")}, "cycles of field buses and filters of currents: 1 to 10 ms")

    def delay(self, theta):
        return theta["delay"]

    def native(self, spec, joints, theta):
        """Sensors `<joint>_torque` of the motors, delayed; none of torques that are early."""
        import mujoco  # here: every command imports the effects, few the engine

        own = [joints[j] for j in self.joints] or joints
        for joint in own if theta["delay"] > 0 else ():
            sensor = spec.add_sensor(name=f"{joint}_torque", type=mujoco.mjtSensor.mjSENS_ACTUATORFRC)
            sensor.objtype, sensor.objname, sensor.interp = mujoco.mjtObj.mjOBJ_ACTUATOR, joint, LINEAR
            sensor.delay, sensor.nsample = theta["delay"], 2 + math.ceil(theta["delay"] / (SHORTEST * spec.option.timestep))
