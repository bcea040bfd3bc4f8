"""Which chains are tried as arms, and what their made-up recordings hold."""

from pathlib import Path

import numpy as np
import pytest
from chains import arm, joint, link, robot

from rrr_oc.robot.robot import load_robot
from validation.every_arm import arms, made_up, sines, table


def test_arms_are_chains_that_were_not_tried_before(tmp_path: Path):
    hand = robot(
        *[link(name, 0 if name == "base" else 1.0) for name in ("base", "l1", "l2", "left", "right")],
        joint("j1", "base", "l1"),
        joint("j2", "l1", "l2"),
        joint("l", "l2", "left"),
        joint("r", "l2", "right"),
    )
    legs = robot(
        *[link(name, 0 if name == "base" else 1.0) for name in ("base", "l1", "l2", "r1", "r2")],
        joint("left1", "base", "l1"),
        joint("left2", "l1", "l2"),
        joint("right1", "base", "r1"),
        joint("right2", "r1", "r2"),
    )
    texts = {"arm": arm(3), "again": arm(3), "hand": hand, "legs": legs, "one": arm(1), "none": "<robot/>"}
    for name, text in texts.items():
        (tmp_path / f"{name}.urdf").write_text(text)
    found = {one.name: one.joints for one in arms(tmp_path, 9)}
    assert found == {"again": None, "hand": ("j1", "j2"), "legs": ("left1", "left2")}
    assert len(arms(tmp_path, 2)) == 2


def test_motions_keep_range_and_speed(tmp_path: Path):
    (tmp_path / "arm.urdf").write_text(arm(3))
    own = load_robot(tmp_path / "arm.urdf")
    motion = sines(own, np.random.default_rng(0))
    assert np.all(np.abs(motion.q) < 2)
    assert np.all(np.abs(motion.dq) <= 0.8 * 3)
    assert motion.dq[0, 1:-1] == pytest.approx(np.gradient(motion.q[0], motion.t)[1:-1], abs=1e-2)  # differences of 10 ms
    columns = next(made_up(own, 0))
    assert np.abs(columns["q_j1"] - columns["q_j1"].mean()).max() > 0.1
    assert set(columns) == {"t", *(f"{kind}_j{k}" for kind in ("q", "tau") for k in (1, 2, 3))}


def test_the_table_counts_what_passes():
    one = {"arm": "a", "n": 2, "seconds": {"init": 1.0}, "failed": {}}
    other = {"arm": "b", "n": 3, "seconds": {"init": 2.0}, "failed": {"design": "no motion"}}
    text = table([one, other])
    assert "1 of 2 arms pass all steps; 1.5 s" in text
    assert "design: no motion" in text
