"""Moving pictures: as many frames as the motion lasts, and what is wrong with a wrong call."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorded import Plant, as_set, record

from rrr_oc import cli
from rrr_oc.codesign.task import load_task
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.report.animation import Scene, _points


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A recording set of half a second, and the npz of a design that stands still and swings one joint."""
    folder, plant = tmp_path_factory.mktemp("animation"), Plant("rrr", np.ones(3), np.ones(3), np.ones(3))
    recordings = as_set(plant, [record(plant, f"{k}.csv", np.random.default_rng(k), 0.5) for k in range(2)])
    save_recordings(replace(recordings), folder / "set")
    t = np.linspace(0.0, 0.4, 21)
    q = np.array([0.5 + t, 0 * t - 1.0])
    np.savez(folder / "PEA.npz", t=t, q=q, tau_load=q, tau_spring=0 * q, payload=np.full(21, 5.0))
    return folder


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["rrr-oc", "animate", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    ("source", "options", "seconds"), [("PEA.npz", ["--task", "paper"], 0.4), ("set", ["--recording", "1.csv"], 0.49)]
)
def test_a_picture_lasts_as_long_as_the_motion(folder, monkeypatch, tmp_path, source, options, seconds):
    assert run(monkeypatch, folder / source, *options, "--out", tmp_path / "a.gif", "--quiet") == 0
    with Image.open(tmp_path / "a.gif") as picture:
        frames = [picture.seek(k) or np.asarray(picture.convert("L"), float) for k in range(picture.n_frames)]
    assert len(frames) == int(seconds * 20 + 1e-9) + 1
    assert np.abs(frames[-1] - frames[0]).max() > 50  # it moves


def test_the_arm_is_drawn_where_kinematics_has_it():
    """The paper's arm stretched along x, links of 0.3 m from a shoulder 0.3 m high, by hand."""
    task = load_task("paper")
    t = np.array([0.0, 1.0])
    scene = Scene(task.robot, task.tool, t, np.zeros((3, 2)), {}, (), 0 * t, "")
    points = _points(scene, np.array([0]))[0]
    np.testing.assert_allclose(points[0], 0.0, atol=1e-12)
    lengths = np.linalg.norm(np.diff(points[-3:], axis=0), axis=1)
    np.testing.assert_allclose(lengths, [np.linalg.norm(task.robot.placements[2][:3, 3]), 0.3], atol=1e-12)


MISTAKES = {
    "no task": (["PEA.npz", "--out", "a.gif"], "--task is missing"),
    "other arm": (["PEA.npz", "--task", "{task}", "--out", "a.gif"], "no task at"),
    "no npz": (["set/0.csv", "--task", "paper", "--out", "a.gif"], "is no npz of a design"),
    "no recording": (["set", "--recording", "2.csv", "--out", "a.gif"], "there are 0.csv, 1.csv"),
    "no picture": (["set", "--out", "a.avi"], "allowed are names that end in .gif or .mp4"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_no_file(folder, monkeypatch, tmp_path, capsys, mistake):
    (source, *options), said = MISTAKES[mistake]
    options = [tmp_path / o if o.startswith("a.") else o for o in options]
    assert run(monkeypatch, folder / source, *options, "--quiet") == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
