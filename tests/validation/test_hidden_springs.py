"""The plant of hidden springs against the package's own torques, which share nothing with it, and what is counted."""

from dataclasses import replace

import numpy as np
import pytest

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.model.metrics import measure
from rrr_oc.robot.robot import load_robot
from rrr_oc.storage import write_text
from validation.hidden_springs import arm, counted, true_E1, write_task

SPRINGS = ({"stiffness": 20.0, "equilibrium": 0.3}, {"stiffness": 5.0, "equilibrium": 0.6})


@pytest.mark.parametrize("number", [0, 1])
def test_true_costs_are_those_of_the_true_links_with_all_springs(number, tmp_path):
    """E1 of a made-up motion, of two joints and of three, computed through Pinocchio and the catalogue's springs."""
    one, rng = arm(number), np.random.default_rng(number)
    write_text(tmp_path / "arm.urdf", one.urdf)
    write_text(tmp_path / "truth.urdf", one.truth)
    write_task(one, tmp_path / "task.json")
    task, truth = load_task(str(tmp_path / "task.json")), load_robot(tmp_path / "truth.urdf")
    apart = np.abs(truth.inertial - task.robot.inertial)[0] / task.robot.inertial[0]
    assert 0.001 < apart.max() < 0.1  # a URDF is never exact
    s = one.spring
    hidden = BiarticularSpring(s.joints, s.winding), np.array([s.kappa, s.rho, s.phi])
    alone = CoDesign(replace(task, robot=truth), spring_bounds(task, "PEA"))
    design, t, motions, torques = alone.with_physics([hidden]), np.linspace(0, 2, 300), [], []
    theta = np.concatenate([*(list(p.values()) for p in SPRINGS), hidden[1]])
    for phase, payload in enumerate(design.task.payloads):
        q, dq, ddq = rng.uniform(-1, 1, (3, 2, 300))  # no motion has these rates, which inverse dynamics does not mind
        tau = design.torques(q, dq, ddq, payload, theta, np.zeros(design.model.widths.size))[0]
        torques.append((t, np.array(tau)))
        motions.append({"t": t + 2 * phase, "q": q, "dq": dq, "ddq": ddq, "phase": np.full(300, phase)})
    motion = {key: np.concatenate([m[key] for m in motions], axis=-1) for key in motions[0]}
    labels = [f"parallel_spring[{joint}]" for joint in task.joints]
    made = {"mounted": {label: {"active": "below"} for label in labels}, "parameters": dict(zip(labels, SPRINGS, strict=True))}
    assert true_E1(one, motion, made) == pytest.approx(measure(torques).E1_total, rel=1e-6)
    without = true_E1(replace(one, spring=replace(s, kappa=0.0)), motion, made)
    assert abs(without - measure(torques).E1_total) > 0.01 * without


def test_what_is_promised_is_counted():
    def result(true: float, low: float, high: float, narrowed: str | None, described: float):
        foreseen = {"E1": [low, high], "narrowed_by": narrowed}
        return {"repaired": {"true": true, "foreseen": foreseen}, "described": {"true": described}}

    found = [
        result(5.0, 4.0, 5.5, None, 9.0),  # all as wanted
        result(6.0, 4.0, 5.5, None, 5.0),  # outside, and worse
        result(5.0, 2.0, 9.0, "PEA.npz", 9.0),  # wide, and said so
        result(5.0, 2.0, 9.0, None, 9.0),
    ]
    assert list(counted(found).values()) == [4, 3, 2, 3, 3]
