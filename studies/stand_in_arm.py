"""An arm in MuJoCo that stands in for a real one: it runs a motion, records itself, and has physics that its URDF lacks.

    python studies/stand_in_arm.py arm.urdf --motion motion.csv --out recordings

The motion, as `rrr-oc excite` writes it, is run at several speeds by a computed-torque controller. The arm has friction and
armature in every joint, which a calibration finds, and hides two things that it cannot find: a mass at the flange that nobody
noted, and friction of one joint that grows with its load. Torques and positions have noise. The plant is MuJoCo's own model of the
URDF and shares no physics with the package.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import typer
from rich.console import Console
from scipy.interpolate import CubicSpline

# pyright: reportAttributeAccessIssue=false
# (mujoco has no stubs)
from rrr_oc.errors import UserError, entry_point
from rrr_oc.recordings.csv_table import read_table
from rrr_oc.storage import new_folder, write_csv, write_json

STEP, SAMPLES = 0.001, 5  # [s] of the engine; steps between two rows of a recording
BANDWIDTH = 20.0  # [rad/s] of the controller
ARMATURE, VISCOUS, DRY = (
    0.02,
    0.03,
    0.03,
)  # of a joint, over the greatest torque of the motion [s², s, 1]; each times 0.5 to 1.5
CROSSING = 0.01  # [rad/s] over which friction changes its sign
NOISE = 2e-3, 1e-5  # of torques, over the greatest of the joint; of positions [rad]
console = Console()


def bare(urdf: Path) -> str:
    """The URDF without shapes, whose files MuJoCo would look for."""
    try:
        robot = ET.parse(urdf).getroot()
    except (OSError, ET.ParseError) as error:
        raise UserError(f"{urdf}: not a URDF that can be read ({error})") from None
    for link in robot.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    return ET.tostring(robot, encoding="unicode")


def compiled(urdf: Path, mass: float) -> mujoco.MjModel:
    """The arm of the URDF with a mass at its last frame, which is fixed to the last link, without friction and armature."""
    spec = mujoco.MjSpec.from_string(bare(urdf))
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # stops at the ends of ranges would push
    spec.compiler.fusestatic = False  # which would lose the mass
    if mass:
        last = spec.joints[-1].parent
        flange = (last.find_all("body") or [last])[-1]
        flange.add_body(mass=mass, inertia=[1e-6 * mass] * 3, explicitinertial=True)
    return spec.compile()


def read_motion(file: Path, joints: list[str]) -> CubicSpline:
    """Positions of the joints over time, as a spline."""
    try:
        t, *q = read_table(file).columns(["t", *(f"q_{joint}" for joint in joints)])
        return CubicSpline(t, np.array(q).T)
    except (UserError, ValueError) as error:
        raise UserError(f"{file}: not a motion of {', '.join(joints)} with columns t and q_<joint> ({error})") from None


class Plant:
    """The arm as it is: MuJoCo's dynamics of its links, and friction and armature beside."""

    def __init__(self, urdf: Path, mass: float, joint: str, over_load: float, seed: int) -> None:
        self.nominal, self.model = compiled(urdf, 0.0), compiled(urdf, mass)
        self.joints = [self.model.joint(j).name for j in range(self.model.njnt)]
        if joint and joint not in self.joints:
            raise UserError(f"--joint is {joint!r}; there are {', '.join(self.joints)}")
        self.over_load = np.array([over_load * (name == joint) for name in self.joints])
        self.rng = np.random.default_rng(seed)

    def fit_to(self, motion: CubicSpline) -> None:
        """Friction, armature and noise of the size that suits the arm: in proportion to the greatest torques of a motion."""
        data, t = mujoco.MjData(self.nominal), np.linspace(motion.x[0], motion.x[-1], 500)
        torque = np.zeros((len(t), self.model.nv))
        for row, now in zip(torque, t, strict=True):
            data.qpos, data.qvel, data.qacc = motion(now), motion(now, 1), motion(now, 2)
            mujoco.mj_inverse(self.nominal, data)
            row[:] = data.qfrc_inverse
        self.greatest = np.abs(torque).max(axis=0)
        self.model.dof_armature[:], self.viscous, self.dry = (
            size * self.greatest * self.rng.uniform(0.5, 1.5, self.model.nv) for size in (ARMATURE, VISCOUS, DRY)
        )

    def run(self, motion: CubicSpline, speed: float) -> dict[str, np.ndarray]:
        """What the arm's sensors record while it runs a motion: t [s], q_ [rad] and the motors' tau_ [Nm]."""
        model, data, plan = self.model, mujoco.MjData(self.model), mujoco.MjData(self.nominal)
        data.qpos, rows, full = motion(motion.x[0]), [], np.zeros((model.nv, model.nv))
        for k in range(int((motion.x[-1] - motion.x[0]) / speed / STEP)):
            now = motion.x[0] + speed * k * STEP
            ahead = motion(now) - data.qpos, speed * motion(now, 1) - data.qvel
            plan.qpos, plan.qvel = data.qpos, data.qvel
            plan.qacc = speed**2 * motion(now, 2) + 2 * BANDWIDTH * ahead[1] + BANDWIDTH**2 * ahead[0]
            mujoco.mj_inverse(self.nominal, plan)
            motor = plan.qfrc_inverse.copy()
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            load = full @ data.qacc - model.dof_armature * data.qacc + data.qfrc_bias
            sign = np.tanh(data.qvel / CROSSING)
            if k % SAMPLES == 0:
                rows.append([k * STEP, *data.qpos, *motor])
            data.qfrc_applied = motor - self.viscous * data.qvel - (self.dry + self.over_load * np.abs(load)) * sign
            mujoco.mj_step(model, data)
        table, n = np.array(rows).T, model.nv
        table[1 : 1 + n] += NOISE[1] * self.rng.normal(size=table[1 : 1 + n].shape)
        table[1 + n :] += NOISE[0] * self.greatest[:, None] * self.rng.normal(size=table[1 + n :].shape)
        return dict(zip(["t", *(f"{kind}_{j}" for kind in ("q", "tau") for j in self.joints)], table, strict=True))


def main(
    urdf: Annotated[Path, typer.Argument(help="the arm")],
    motion: Annotated[list[Path], typer.Option(help="CSV file with t and q_<joint>; may be given several times")],
    out: Annotated[Path, typer.Option(help="folder to make, with the recordings and recordings.json")],
    mass: Annotated[float, typer.Option(min=0, help="that nobody noted, at the flange \\[kg]")] = 1.0,
    joint: Annotated[str, typer.Option(help="whose friction grows with its load; default: none")] = "",
    over_load: Annotated[float, typer.Option(min=0, help="this friction over the load torque")] = 0.12,
    speeds: Annotated[str, typer.Option(help="comma-separated, over the motion's own")] = "1,0.7,0.5",
    seed: Annotated[int, typer.Option(min=0, help="of friction, armature and noise")] = 0,
) -> None:
    """Run motions on the stand-in arm and record them."""
    try:
        shares = [float(s) for s in speeds.split(",")]
    except ValueError:
        shares = []
    if not shares or not all(0 < s < np.inf for s in shares):
        raise UserError(f"--speeds is {speeds!r}; numbers above 0, separated by commas, are required")
    arm = Plant(urdf, mass, joint, over_load, seed)
    motions = [read_motion(file, arm.joints) for file in motion]
    arm.fit_to(motions[0])
    with new_folder(out) as folder:
        files = []
        for number, path in enumerate(motions):
            for speed in shares:
                files.append(f"motion{number + 1}_speed{speed:g}.csv")
                write_csv(folder / files[-1], arm.run(path, speed))
        header = {"format": "rrr_oc-recordings/1", "robot": str(urdf.resolve()), "joints": arm.joints}
        write_json(folder / "recordings.json", header | {"recordings": [{"file": name} for name in files]})
    console.print(f"{out} holds {len(files)} recordings of {', '.join(arm.joints)}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
