# pyright: reportAttributeAccessIssue=false
"""Families of arms whose recordings pass a chain of measurement: the plant, the chain, and how a diagnosis is scored."""

import ast
import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from validation.chains.chain import FINE, Chain, measure
from validation.chains.effects import LAWS, Effect, Motion
from validation.chains.families import FAMILIES, RESERVED
from validation.chains.make import new_case, write
from validation.chains.motions import points, sines
from validation.chains.scoring import Sealed, score

PLANT = Path(__file__).resolve().parents[2] / "validation" / "chains"
TOLD = {"verdict": "nothing_missing", "effects": [], "unexplained": [], "link_findings": []}


def small(name, kind, tmp_path, effects=None, seconds=2.0):
    """A case of one short recording, written; its folder."""
    case = new_case(name, 0, kind, seed=5)
    case = replace(case, family=replace(case.family, pace=replace(case.family.pace, seconds=seconds), recordings=1))
    case = case if effects is None else replace(case, effects=effects)
    write(case, tmp_path, seed=5)
    return tmp_path / case.name


def sealed(folder):
    return Sealed.read(folder / "sealed", json.loads((folder / "sealed" / "truth.json").read_text()))


def test_the_plant_does_not_import_the_tool():
    for path in [*PLANT.glob("*.py"), *PLANT.glob("families/*.py")]:
        if path.stem not in ("calibrations", "diagnoses", "drawn_arms", "reliability"):
            nodes = list(ast.walk(ast.parse(path.read_text())))
            names = [n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)]
            names += [a.name for n in nodes if isinstance(n, ast.Import) for a in n.names]
            assert not any(name.startswith("rrr_oc") for name in names), path


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_makes_a_case(name, tmp_path):
    folder = small(name, "both" if name in RESERVED else "links", tmp_path)
    head = json.loads((folder / "recordings" / "recordings.json").read_text())
    arrays = np.load(folder / "sealed" / "missing.npz")
    for entry in head["recordings"]:
        rows = np.genfromtxt(folder / "recordings" / entry["file"], delimiter=",", names=True)
        assert np.all(np.diff(rows["t"]) > 0)
        assert rows.size == arrays[f"{entry['file']}|missing"].shape[1]
        assert all(np.isfinite(rows[column]).all() for column in rows.dtype.names)
        assert np.abs(rows["q_j1"] - arrays[f"{entry['file']}|q"][0]).max() < 0.01  # encoders of 12 bit and more
    truth = json.loads((folder / "sealed" / "truth.json").read_text())
    assert truth["off"]["felt_as"][truth["off"]["link"]] > 0.99


def test_a_case_is_the_same_every_time(tmp_path):
    one, two = (small("servos", "hidden", tmp_path / part) / "recordings" / "r0.csv" for part in "ab")
    assert one.read_text() == two.read_text()


def test_delay_and_filters_are_measured_back():
    t, q, v, _ = sines(1, replace(FAMILIES["late_arm"].pace, seconds=20.0, slowest=1.0), np.random.default_rng(0))
    chain = Chain(rate=FINE, bits=30, speed="filtered", speed_cutoff=25.0, torque_late=0.008, torque_cutoff=30.0)
    rows = measure(chain, t, (q, v, v), np.ones(1), np.random.default_rng(0))
    inside = slice(1000, 39000)

    def lag(x):
        shifts = np.arange(0, 60)
        return shifts[np.argmax([np.dot(np.roll(v[0], k)[inside], x[0][inside]) for k in shifts])] / FINE

    assert rows.dq is not None
    assert lag(rows.tau) == pytest.approx(
        chain.torque_lag, abs=0.001
    )  # two steps: at 3 Hz a filter is a little less late than at 0
    assert lag(rows.dq) == pytest.approx(chain.speed_lag, abs=0.001)
    wave = np.sin(2 * np.pi * 30 * t)[None]
    late = measure(Chain(rate=FINE, torque_cutoff=30.0), t, (wave, wave, wave), np.ones(1), np.random.default_rng(0)).tau
    assert np.abs(late[0, inside]).max() == pytest.approx(np.sqrt(0.5), rel=0.05)  # at its cutoff; the filter is one of 2000 Hz


@pytest.mark.parametrize("plan", [sines, points])
def test_motions_have_their_derivatives(plan):
    t, q, v, a = plan(3, FAMILIES["late_arm"].pace, np.random.default_rng(1))
    assert np.abs(np.gradient(q, t, axis=1) - v)[:, 1:-1].max() < 1e-4
    assert np.abs(np.gradient(v, t, axis=1) - a)[:, 1:-1].max() < 0.06  # where a polynomial begins, a jumps in its slope


def test_missing_torque_is_that_of_another_engine(tmp_path):
    effects = (Effect("cable_harness", (1,), {"stiffness": 3.0, "rest": 0.2}),)
    folder = small("late_arm", "both", tmp_path, effects=effects)
    truth, x = json.loads((folder / "sealed" / "truth.json").read_text()), np.load(folder / "sealed" / "missing.npz")
    q, v, a, tau, missing = (x[f"r0.csv|{name}"].astype(float) for name in ("q", "v", "a", "tau", "missing"))
    need = {}
    for name, file in (("urdf", folder / "recordings" / "arm.urdf"), ("true", folder / "sealed" / "true.urdf")):
        model = mujoco.MjModel.from_xml_string(file.read_text())
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
        data, torques = mujoco.MjData(model), []
        for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q.T, v.T, a.T, strict=True):
            mujoco.mj_inverse(model, data)
            torques.append(data.qfrc_inverse.copy())
        need[name] = np.array(torques).T
    dry, viscous, rotor = (np.array(list(truth[name].values()))[:, None] for name in ("dry", "viscous", "rotor"))
    plain = dry * np.tanh(v / truth["sign_width"]) + viscous * v + rotor * a
    assert tau - plain - need["urdf"] == pytest.approx(missing, abs=2e-4)  # written with six digits
    spring = 3.0 * (q[1] - 0.2)
    assert (tau - plain - need["true"])[1] == pytest.approx(spring, abs=2e-4)


def test_an_engine_without_effects_misses_nothing(tmp_path):
    one = sealed(small("held_arm", "clean", tmp_path))
    assert np.abs(one.x["hidden"]).max() < 1e-3 * np.abs(one.x["tau"]).max()
    assert one.felt == []


@pytest.mark.parametrize("name", [name for name, law in LAWS.items() if law.acts == "motor"])
def test_laws_act_at_a_time_as_over_a_motion(name):
    rng, law = np.random.default_rng(3), LAWS[name]
    x = Motion(*(rng.standard_normal((2, 5)) for _ in range(4)), np.arange(5.0))
    effect = Effect(name, (0, 1)[: law.joints], law.draw(rng, 0.3, 2.0))
    for _, row in [] if law.whole else effect.of(x):
        assert np.shape(row) == (5,)
    for (_, whole), (_, once) in (
        [] if law.whole else zip(effect.of(x), effect.of(Motion(*(y[:, 2] for y in x[:4]), x.t[2])), strict=True)
    ):
        assert once == pytest.approx(whole[2])


def test_scores_count_what_is_said_right_and_wrong(tmp_path):
    spring = (Effect("cable_harness", (1,), {"stiffness": 3.0, "rest": 0.2}),)
    one = sealed(small("late_arm", "hidden", tmp_path, effects=spring, seconds=15.0))

    def scored(effects=(), unexplained=(), **more):
        return score(TOLD | {"effects": effects, "unexplained": unexplained} | more, one)

    assert scored()["hidden/silent"] == 1
    right = scored([{"effect": "cable_harness", "joint": "j2"}])
    assert (right["claims/false"], right["hidden/where"], right["hidden/on what"], right["known law/told"]) == (0, 1, 1, 1)
    wrong = scored([{"effect": "quadratic_drag", "joint": "j3"}])
    assert (wrong["claims/false"], wrong["hidden/where"], wrong["known law/told"]) == (1, 0, 0)
    assert (
        scored([{"effect": "quadratic_drag", "joint": "j3", "rivals": [{"effect": "cable_harness", "joint": "j2"}]}])[
            "claims/false"
        ]
        == 0
    )
    torque = scored(unexplained=[{"joint": "j2", "depends_on": ["q_j2"]}])
    assert (torque["hidden/where"], torque["hidden/on what"], torque["known law/told"], torque["torques/false"]) == (1, 1, 0, 0)
    assert scored(unexplained=[{"joint": "j2", "depends_on": ["dq_j2"]}])["hidden/on what"] == 0


def test_a_true_delay_of_a_clean_arm_is_right(tmp_path):
    one, delay = sealed(small("late_arm", "clean", tmp_path)), {"effect": "time_delay", "joint": None}
    right, wrong = (
        score(TOLD | {"verdict": "missing_physics", "effects": e}, one)
        for e in ([delay], [{"effect": "backlash", "joint": "j1"}])
    )
    assert (right["clean/right"], right["claims/false"], wrong["clean/right"], wrong["claims/false"]) == (1, 0, 0, 1)


@pytest.mark.parametrize(("order", "right"), [(260.3, True), (262.0, False)])
def test_a_ripple_of_the_measured_torque_is_right_but_no_hidden_law(order, right, tmp_path):
    one = sealed(small("current_arm", "clean", tmp_path))
    one.truth["chain"] |= {"ripple": 0.03, "ripple_cycles": 260.0}
    ripple = {"effect": "torque_ripple", "joint": one.joints[0], "parameters": {"order": {"value": order}}, "rivals": []}
    assert one.there(ripple) is right
    assert not one.right(ripple)
    one.truth["effects"].append({"effect": "torque_ripple", "joint": one.joints[0]})
    assert one.there(ripple)


def test_scores_of_links_and_events(tmp_path):
    one = sealed(small("leg", "links", tmp_path))
    off, other = one.truth["off"]["link"], next(link for link in one.links if not one.off(link))
    counts = score(TOLD | {"link_findings": [{"link": off}, {"link": other}]}, one)
    assert (counts["links off/told"], counts["links told"], counts["links told/right"]) == (1, 2, 1)
    one.truth["events"].clear()
    one.truth["events"]["r0.csv"] = [{"joint": "j2", "from": 1.0, "to": 1.2}]
    told = [
        {"joint": "j2", "recording": "r0.csv", "from": 1.1, "to": 1.3},
        {"joint": "j1", "recording": "r0.csv", "from": 2, "to": 3},
    ]
    counts = score(TOLD | {"events": told}, one)
    assert (counts["pushes"], counts["pushes/told"], counts["events"], counts["events/right"]) == (1, 1, 2, 1)


def test_a_wrong_link_is_measured_by_the_usual_errors_that_feel_alike(tmp_path):
    """Of links whose masses are all 3 % more than in the file, which are as many usual errors as there are links."""
    one = sealed(small("held_arm", "clean", tmp_path, seconds=15.0))
    data = one.model.createData()
    one.x["links"] = (
        0.03 * np.array([pin.rnea(one.model, data, *row) for row in zip(*(one.x[k].T for k in "qva"), strict=True)]).T
    )
    once = one.usual_errors()
    assert 0.3 < once <= np.sqrt(one.model.nv) + 1e-6
    one.x["links"] *= 4
    assert one.usual_errors() == pytest.approx(4 * once)
    one.x["links"] *= 0
    assert one.usual_errors() == 0
