"""Arms drawn from a model: their files in plain MuJoCo against Pinocchio, and how far they differ."""

import json
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from commands import rrr_oc as command

import rrr_oc
from rrr_oc.calibration.calibrated_model import Alternative, CalibratedModel, Estimate, Term
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.effects import CATALOGUE
from rrr_oc.robot.robot import load_robot, urdf_text

STIFFNESS, STD = 6.0, 0.4  # [Nm/rad], of the harness of joint 2
MASS = 0.05  # [kg], standard deviation of the last link's
LAST = 20  # number of the last link's mass among the inertial parameters


def model() -> CalibratedModel:
    """The paper's arm with a harness that was found, of which the stiffness is not known, nor, independently of it, the last link's mass."""
    robot, none = load_robot("rrr"), np.zeros(3)
    terms = (
        Term(CATALOGUE["cable_harness"]((1,)), (Estimate(STIFFNESS, STD), Estimate(0.3))),
        Term(CATALOGUE["viscous_friction"]((2,)), (Estimate(1.5),)),
    )
    spread = np.zeros((3 + 30, 2))
    spread[0, 0], spread[3 + LAST, 1] = STD, MASS
    constants = (None,) * 3
    return CalibratedModel(
        robot, "rrr", urdf_text("rrr"), robot.tool, "motor", constants, "nominal", terms, none, none, spread=spread
    )


@pytest.fixture
def file(tmp_path):
    save_model(model(), tmp_path / "model.json")
    return tmp_path / "model.json"


def test_drawn_arms_have_the_physics_and_differ_by_what_is_not_known(file, tmp_path):
    count = 60
    found = rrr_oc.export(file, tmp_path / "out", samples=count, seed=3, quiet=True)
    assert len(found.samples) == count
    arms = [mujoco.MjModel.from_xml_path(path) for path in found.samples]
    stiffness, mass = (np.array(x) for x in ([a.tendon_stiffness[0] for a in arms], [a.body("link3").mass[0] for a in arms]))
    # of 60 draws a mean is known to 0.13 and a standard deviation to 0.09 of the standard deviation; four times that
    for drawn, middle, std in ((stiffness, STIFFNESS, STD), (mass, load_robot("rrr").inertial[0, 2], MASS)):
        assert abs(drawn.mean() - middle) < 0.52 * std
        assert drawn.std() == pytest.approx(std, rel=0.36)
    assert abs(np.corrcoef(stiffness, mass)[0, 1]) < 0.5
    assert [a.dof_damping[2] for a in arms] == pytest.approx([1.5] * count)


def test_a_drawn_arm_and_its_model_are_the_same_arm(file, tmp_path):
    """Torques of random states in plain MuJoCo, and by Pinocchio with the links of the model and the laws written out."""
    found, rng = rrr_oc.export(file, tmp_path / "out", samples=3, quiet=True), np.random.default_rng(0)
    for path in found.samples:
        mj, drawn = mujoco.MjModel.from_xml_path(path), load_model(path.replace(".xml", ".json"))
        (stiffness, rest), (viscous,) = (t.values for t in drawn.terms)
        body = pin.buildModelFromXML(urdf_text("rrr"))
        for j, link in enumerate(drawn.robot.inertial.T):
            body.inertias[j + 1] = pin.Inertia.FromDynamicParameters(link)
        for q, dq, ddq in rng.uniform(-1, 1, (10, 3, 3)):
            q = 0.5 * (drawn.robot.lower + drawn.robot.upper) + 0.2 * q
            data = mujoco.MjData(mj)
            data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
            mujoco.mj_inverse(mj, data)
            own = pin.rnea(body, body.createData(), q, dq, ddq)
            own += np.array([0.0, stiffness * (q[1] - rest), viscous * dq[2]])
            np.testing.assert_allclose(data.qfrc_inverse, own, rtol=2e-5, atol=2e-5)  # six digits in the file


def test_the_seed_decides_and_old_samples_go(file, tmp_path, monkeypatch):
    def drawn(count: int, seed: int) -> list[str]:
        assert command(monkeypatch, "export", file, "--out", tmp_path / "e", "--samples", count, "--seed", seed, "--quiet") == 0
        return [path.read_text() for path in sorted((tmp_path / "e" / "samples").glob("*.xml"))]

    five, again, two, other = drawn(5, 0), drawn(5, 0), drawn(2, 0), drawn(2, 1)
    assert five == again
    assert two == five[:2]
    assert other[0] != two[0]
    names = sorted(path.name for path in (tmp_path / "e" / "samples").iterdir())
    assert names == ["001.json", "001.xml", "002.json", "002.xml", "samples.json"]


def test_models_that_are_as_good_take_turns(tmp_path):
    one = model()
    other = replace(one, terms=one.terms[1:], spread=np.zeros((1 + 30, 1)))
    whole = replace(one, alternatives=(Alternative(other, "without cable_harness of joint2"),))
    save_model(whole, tmp_path / "model.json")
    found = rrr_oc.export(tmp_path / "model.json", tmp_path / "out", samples=4, quiet=True)
    assert [mujoco.MjModel.from_xml_path(path).ntendon for path in found.samples] == [1, 0, 1, 0]
    listed = json.loads((tmp_path / "out" / "samples" / "samples.json").read_text())["samples"]
    assert [row["drawn_from"] for row in listed[:2]] == ["as calibrated", "without cable_harness of joint2"]


def test_draws_of_no_possible_arm_are_drawn_again(tmp_path):
    """A last link of 1 + z times its numbers, z normal: nothing weighs less than nothing, which one draw in six would."""
    link = np.concatenate([np.zeros(3 + LAST), load_robot("rrr").inertial[:, 2]])[:, None]
    save_model(replace(model(), spread=link), tmp_path / "model.json")
    found = rrr_oc.export(tmp_path / "model.json", tmp_path / "out", samples=40, quiet=True)
    assert 1 <= found.content["refused_draws"] <= 20
    assert min(mujoco.MjModel.from_xml_path(path).body("link3").mass[0] for path in found.samples) > 0


@pytest.mark.parametrize(
    ("size", "said"),
    [(None, "does not say how well its parameters are known"), (1e3, "of 100 draws (as calibrated) none is a possible")],
)
def test_what_cannot_be_drawn_is_said(size, said, tmp_path, monkeypatch, capsys):
    """No body has moments of inertia that differ by 1000 kg m² where the third is as small as this link's."""
    spread = None if size is None else np.concatenate([np.zeros((3, 1)), size * np.eye(30)[:, LAST + 4 : LAST + 5]])
    save_model(replace(model(), spread=spread), tmp_path / "model.json")
    assert command(monkeypatch, "export", tmp_path / "model.json", "--out", tmp_path / "e", "--samples", 2) == 2
    assert said in capsys.readouterr().err
    assert not list((tmp_path / "e").glob("samples/*"))


def test_samples_need_a_model(tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, "export", "--out", tmp_path / "e", "--samples", 2) == 2
    assert "--samples needs a model.json" in capsys.readouterr().err
    assert not (tmp_path / "e").exists()
