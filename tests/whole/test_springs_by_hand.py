"""A design built from its report by hand: MuJoCo reads the URDF's bodies, and the springs are joints and tendons made of what the list of
springs to order and the sentences on their mounts say. Nothing of the project's own models, laws of springs or exports takes part."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from commands import rrr_oc

from rrr_oc.robot.robot import urdf_text

SMALL = ["--configurations", "PEA+BPEA", "--starts", "1", "--motions", "0", "--intervals", "16", "--tolerance", "1e-2"]
MAKES = ("torsion", "extension", "compression")


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """The folder of a small design of the paper's task."""
    folder = tmp_path_factory.mktemp("by_hand")
    with pytest.MonkeyPatch.context() as patch:
        extra = ["--catalogue", "none", "--cycle-times", "none", "--jobs", "1"]
        assert rrr_oc(patch, "design", "paper", *SMALL, *extra, "--out", folder) == 0
    return folder


def table(report: str, after: str) -> list[dict[str, str]]:
    """The rows of the first table after a line, by the heads of its columns."""
    blocks = report.partition(f"\n{after}\n")[2].strip().split("\n\n")
    head, _, *rows = next(block for block in blocks if block.startswith("|")).splitlines()
    cells = [[cell.strip() for cell in row.strip("|").replace(r"\|", "∣").split("|")] for row in (head, *rows)]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[1:]]


def number(words: str) -> float:
    return float(re.match(r"-?[\d.]+", words)[0])


def ordered(report: str, make: str) -> dict[str, dict[str, str]]:
    """The row of each spring, by its name, of those that are made in one way."""
    found, name = {}, ""
    for row in table(report, "### Springs of PEA+BPEA"):
        name = row["spring"] or name
        if row["made as"].partition(",")[0] == make:
            found[name] = row
    return found


def bodies() -> mujoco.MjSpec:
    """The URDF as MuJoCo itself reads it, without damping, friction and limits."""
    spec = mujoco.MjSpec.from_string(urdf_text("rrr"))
    for joint in spec.joints:
        joint.limited, joint.damping, joint.frictionloss = mujoco.mjtLimited.mjLIMITED_FALSE, [0, 0, 0], 0.0
    spec.option.gravity = [0, 0, -9.81]
    return spec


def tendon(spec: mujoco.MjSpec, arms: dict[str, float], rate: float, pulls_above: float) -> None:
    """A spring that pulls where Σ arm · angle is greater than a length, and is slack elsewhere."""
    made = spec.add_tendon()
    made.stiffness, made.springlength = [rate, 0, 0], [-1e3, pulls_above]
    for joint, arm in arms.items():
        made.wrap_joint(joint, arm)


def with_springs(report: str, make: str) -> mujoco.MjSpec:
    """The arm with each spring of the order list, on a pulley where it has one."""
    spec = bodies()
    hardware = table(report, "## Hardware and durations")[0]
    radius = {i: number(hardware[f"r_{i} [mm]"]) / 1e3 for i in (1, 2, 3)}
    for name, row in ordered(report, make).items():
        pulley = re.search(r"pulley ([\d.]+) mm", row["made as"])
        rate, slack = number(row["rate"]), np.radians(number(row["unloaded at"]))
        assert ("Nm/rad" if pulley is None else "N/mm") in row["rate"]
        r, rate = (1.0, rate) if pulley is None else (float(pulley[1]) / 1e3, 1e3 * rate)
        (says,) = re.findall(rf"- The {name} acts (.*)", report)
        if "while its cable is taut" in says:
            arms = {
                joint: radius[int(i)] * (-1 if sign == "−" else 1)
                for sign, i, joint in re.findall(r"([−+]) r_(\d) (\w+)", says)
            }
            assert len(arms) == 2
            if pulley is None:  # the spring turns with the pulley r_1
                arms = {joint: arm / radius[1] for joint, arm in arms.items()}
            tendon(spec, arms, rate, r * slack)
        else:
            joint, side = re.match(r"where (\w+) is (below|above) the angle at which it is unloaded", says).groups()
            if pulley is None and number(row["deflection"]) > 0:  # on the axis, and never slack: a spring of the joint itself
                own = spec.joint(joint)
                own.stiffness, own.springref = [rate, 0, 0], slack
            else:
                sign = -1 if side == "below" else 1
                tendon(spec, {joint: sign * r}, rate, sign * r * slack)
    return spec


def load_carrying(spec: mujoco.MjSpec, kg: float) -> mujoco.MjModel:
    """The arm with a point mass in its hand, which the task puts 0.3 m along link 3."""
    copy = spec.copy()
    if kg:
        copy.body("link3").add_body(pos=[0.3, 0, 0]).add_geom(size=[1e-3, 0, 0], mass=kg)
    return copy.compile()


def cost(spec: mujoco.MjSpec, file: Path) -> dict[str, float]:
    """∫ torque² dt of each joint that moves [N²m²s], by MuJoCo's inverse dynamics along a motion."""
    found = {}
    with np.load(file) as motion:
        moving = [str(joint) for joint in motion["joints"]]
        for phase in (0, 1):
            at = motion["phase"] == phase
            (kg,) = set(motion["payload"][at])
            model = load_carrying(spec, kg)
            data, dofs = mujoco.MjData(model), [model.joint(joint).dofadr[0] for joint in moving]
            torque = []
            for q, dq, ddq in zip(*(motion[key][:, at].T for key in ("q", "dq", "ddq")), strict=True):
                data.qpos[:], data.qvel[:], data.qacc[:] = 0, 0, 0
                data.qpos[dofs], data.qvel[dofs], data.qacc[dofs] = q, dq, ddq
                mujoco.mj_inverse(model, data)
                torque.append(data.qfrc_inverse[dofs].copy())
            own = np.trapezoid(np.square(torque), motion["t"][at], axis=0)
            found = {joint: found.get(joint, 0.0) + one for joint, one in zip(moving, own, strict=True)}
    return found


@pytest.mark.parametrize("make", MAKES)
def test_a_design_built_from_its_report_costs_what_the_report_says(out, make):
    """The list has four digits of a rate and tenths of a degree: of E1 0.5 %, since springs are where its slope is zero or at bounds."""
    report = (out / "report.md").read_text()
    says = json.loads((out / "summary.json").read_text())["configurations"]["PEA+BPEA"]["tasks"]["paper"]
    built = with_springs(report, make)
    assert built.compile().ntendon == (1 if make == "torsion" else 3)
    joints = cost(built, out / "PEA+BPEA.npz")
    assert sum(joints.values()) == pytest.approx(says["E1"], rel=5e-3)
    assert joints == pytest.approx(says["E1_joint"], rel=1e-2)
    printed = re.search(r"E1 is ([\d.]+) N²m²s", report)
    assert sum(joints.values()) == pytest.approx(float(printed[1]), rel=1e-2)


def test_without_one_of_its_springs_the_arm_needs_much_more(out):
    """Each part of the list carries: what is compared above is no matter of the arm alone."""
    report = (out / "report.md").read_text()
    whole = sum(cost(with_springs(report, "extension"), out / "PEA+BPEA.npz").values())
    for name in ordered(report, "extension"):
        spec = with_springs(report, "extension")
        at = [*ordered(report, "extension")].index(name)
        spec.delete(spec.tendons[at])
        assert sum(cost(spec, out / "PEA+BPEA.npz").values()) > 1.5 * whole, name
