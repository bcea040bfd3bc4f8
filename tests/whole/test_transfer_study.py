"""The study of transfer: the repaired design against the independent plant, and its stages on a model that is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.codesign.transfer import repaired
from rrr_oc.effects.body.payload_mass import PayloadMass
from rrr_oc.effects.elastic.cable_harness import CableHarness
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.model.motion import Motion
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.recordings.recording import Recording, RecordingSet
from studies import transfer as study
from studies.paper.sweeps import PROTOTYPE_SWEEP

ARMS = study.prototypes(3)
EFFECTS = {"payload": PayloadMass(()), "spring": ParallelSpring((1,), "below"), "harness": CableHarness((2,))}


@pytest.fixture(scope="module")
def task():
    return load_task("prototype")


def known(arm: study.Prototype, task) -> tuple[CalibratedModel, CalibratedModel]:
    """The plain model with the plant's own friction, and the same with what the plant hides."""
    plan = Recording.planned("a", Motion(np.zeros(20), *np.zeros((3, 3, 20)), np.zeros(20)))
    only = (study.planned(plan),)
    recordings = RecordingSet(task.robot, "rrr_prototype", "motor", "nominal", task.tool, (None,) * 3, only, Path("made_up"))
    start, own = plain_model(recordings), arm.arm
    values = np.column_stack([own.coulomb, own.viscous, own.armature]).ravel()
    plain = replace(
        start,
        terms=tuple(t.with_values(np.array([v])) for t, v in zip(start.prompt_terms, values, strict=True)),
        noise=np.ones(3),
    )
    plain = replace(plain, nrmse=np.ones(3))
    effect, (true,) = EFFECTS[arm.name], arm.truth()
    estimates = tuple(Estimate(float(true["parameters"][p.name])) for p in effect.parameters)
    where = {"recordings": (), "groups": ("payload", "payload_springs")} if arm.name == "payload" else {}
    width = None if effect.width is None else 1e-4
    return plain, replace(plain, terms=(*plain.terms, Term(effect, estimates, width, **where)))


def smooth_plans(task, springs=()) -> list[Recording]:
    """Polynomials from start to release and back."""
    s, period, plans = np.linspace(0, 1, 200), 1.5, []
    for i, name in enumerate(("go", "return")):
        one, two = (task.full(x)[:, None] for x in task.ends(i))
        q = one + (two - one) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        dq = (two - one) * (30 * s**2 - 60 * s**3 + 30 * s**4) / period
        ddq = (two - one) * (60 * s - 180 * s**2 + 120 * s**3) / period**2
        motion = Motion(s * period, q, dq, ddq, np.full(len(s), task.payloads[i]))
        plans.append(Recording.planned(name, motion, springs))
    return plans


@pytest.mark.parametrize("name", EFFECTS)
def test_the_repaired_design_has_the_load_torque_of_the_plant(name, task):
    arm, labelled = ARMS[name], CoDesign(task, spring_bounds(task, "PEA"))
    _, true = known(arm, task)
    mounted = tuple(
        (ParallelSpring((j,)), {"stiffness": k, "equilibrium": rest}) for j, k, rest in ((1, 9.0, 1.9), (2, 0.7, 2.0))
    )
    plans = smooth_plans(task, mounted)
    moved, designs = arm.moves(plans, study.helped_by(true, plans)), (labelled, repaired(labelled, true, study.GROUPS))
    errors = []
    for design in designs:
        theta = np.r_[9.0, 1.9, 0.7, 2.0, *[v for s in design.springs if s.known for v in s.lower]]
        for payload, (one, load) in zip(design.task.payloads, moved, strict=True):
            motion = (x[0][list(task.moving)] for x in (one.q, one.dq, one.ddq))
            predicted = np.array(design.torques(*motion, payload, theta, 1e-4 * np.ones(design.model.widths.size))[0])
            errors.append(np.abs(predicted - load[list(task.moving)]).max())
    # the plant's accelerations are half a step of 2 ms off its speeds; springs round their corner over 1e-4 rad
    assert max(errors[2:]) < 0.05
    assert max(errors[:2]) > 1.0
    assert designs[1].hardware(theta) == pytest.approx({"k_p2": 9.0, "q_eq2": 1.9, "k_p3": 0.7, "q_eq3": 2.0})


def test_what_comes_and_goes_between_the_phases_is_refused(task):
    _, true = known(ARMS["harness"], task)
    some = replace(true.terms[-1], recordings=(), groups=("bare",))
    with pytest.raises(UserError, match="cable_harness holds for bare"):
        repaired(CoDesign(task, ()), replace(true, terms=(*true.terms[:-1], some)), study.GROUPS)


def test_help_of_a_good_model_keeps_the_arm_on_its_way(task):
    arm = ARMS["spring"]
    plain, true = known(arm, task)
    plans = smooth_plans(task)
    with_truth, without = (study.cost_on(arm, plans, model, task.moving) for model in (true, plain))
    assert with_truth["stray_rad"] < 0.02
    assert without["stray_rad"] > 2 * with_truth["stray_rad"]


def test_wanted_sweeps_are_as_fast_as_the_task(task):
    quick = study.faster(task, PROTOTYPE_SWEEP)
    speed = np.abs(quick.motion(np.linspace(0, 60, 5000), "rising")[1]).max(axis=1)
    assert speed[1:] == pytest.approx(task.speed, rel=0.1)
    assert quick.fast[0] == PROTOTYPE_SWEEP.fast[0]  # the task does not move joint 1


def test_the_loop_on_a_model_that_is_known(task, tmp_path, monkeypatch):
    """The stages after the diagnosis, whose place the truth takes here; a second run takes everything from its files."""
    arm = ARMS["payload"]
    found = {"verdict": "missing_physics", "effects": [], "unexplained": [], "nrmse": {}, "suggested_recordings": []}
    monkeypatch.setattr(study, "diagnosed", lambda *_: (*known(arm, task), found))
    monkeypatch.setattr(study.Prototype, "record", lambda *_: None)
    options = SearchOptions(starts=2, kept=1, motions=0, coarse=8, fine=16, refinement=Refinement(1e-2))
    content = study.loop(tmp_path, arm, task, PROTOTYPE_SWEEP, ["SA"], options)
    one, two = (content["designs"]["SA"][kind] for kind in ("labelled", "repaired"))
    assert two["on_arm"]["E1"] < one["steered"]["E1"] * 1.01
    assert abs(two["predicted"] / two["on_arm"]["E1"] - 1) < 0.05
    assert abs(one["predicted"] / one["steered"]["E1"] - 1) > 0.2
    assert two["engine"] == pytest.approx(two["predicted"], rel=0.02)
    monkeypatch.setattr(study, "solve_multistart", lambda *_: pytest.fail("searched again"))
    monkeypatch.setattr(study, "cost_on", lambda *_: pytest.fail("driven again"))
    assert study.loop(tmp_path, arm, task, PROTOTYPE_SWEEP, ["SA"], options) == json.loads(json.dumps(content))
    truth = {"payload": arm.truth()}
    text = study.report({"asked": {"preset": "prototype", "seconds": 60, "seed": 3, "starts": 2}, "failure": None,
                         "loop": {"payload": content}, "truth": truth})  # fmt: skip
    assert f"| payload | SA | {one['predicted']:.2f} |" in text
    assert "Hidden: payload_mass of the arm, mass" in text


def test_bad_options_are_one_sentence(tmp_path):
    with pytest.raises(UserError, match="--arms is nothing; allowed are drives, payload, spring, harness"):
        study.main(tmp_path, arms="nothing")
    with pytest.raises(UserError, match="is a task of the robot 'rrr'"):
        study.main(tmp_path, preset="paper")
