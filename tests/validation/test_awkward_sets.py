"""Awkward sets follow from their numbers and are what they are called, and what counts as a fault of their diagnosis."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rrr_oc.recordings.reader import load_recordings
from validation import awkward_sets as awkward


def number(name: str) -> int:
    return list(awkward.WAYS).index(name)


@pytest.mark.parametrize("i", [*map(number, ("usual", "0.7 s", "still", "one", "50 ms late")), 40])
def test_a_set_is_read_and_follows_from_its_number(i, tmp_path):
    awkward.write_set(i, tmp_path / "one")
    awkward.write_set(i, tmp_path / "two")
    every = [sorted(path.read_bytes() for path in (tmp_path / name).iterdir()) for name in ("one", "two")]
    assert every[0] == every[1]
    name, _, way = awkward.described(i)
    found = load_recordings(tmp_path / "one")
    assert (found.robot.n, len(found.recordings)) == (len(awkward.ARMS[name]), way.count)


def test_ways_are_what_they_are_called():
    def made(name: str, arm: str = "planar") -> dict[str, np.ndarray]:
        return awkward.recorded(np.random.default_rng(1), awkward.Way(**awkward.WAYS[name]), awkward.ARMS[arm])

    usual = made("usual")
    assert usual["t"][-1] == pytest.approx(3.99)
    assert np.ptp(made("still")["q_j2"]) == 0
    assert np.all(np.diff(made("one way")["q_j1"]) > 0)
    assert not np.any(made("torque 0")["tau_j1"])
    saturated = made("saturated")["tau_j1"]
    assert np.mean(np.abs(saturated) == np.abs(saturated).max()) > 0.02
    np.testing.assert_allclose(made("absolute")["q_j2"], usual["q_j1"] + usual["q_j2"], atol=1e-5)
    np.testing.assert_array_equal(made("swapped")["tau_j2"], usual["tau_j1"])
    pull = made("spring")["tau_j2"] - usual["tau_j2"]
    np.testing.assert_allclose(pull, 3.0 * (usual["q_j2"] - 3.0), atol=0.3)  # of noise, which is larger beside it
    pendulum = made("no noise", "pendulum")
    rest = int(np.argmin(np.abs(np.gradient(pendulum["q_j1"]))))
    mass, centre, inertia = awkward.LINK
    speed, acceleration = (
        x[rest] for x in (np.gradient(pendulum["q_j1"], 0.01), np.gradient(np.gradient(pendulum["q_j1"], 0.01), 0.01))
    )
    by_hand = (inertia + mass * centre**2 + awkward.ROTOR) * acceleration - mass * 9.81 * centre * np.sin(
        pendulum["q_j1"][rest]
    )
    by_hand += awkward.DRY * np.tanh(speed / awkward.WIDTH) + awkward.VISCOUS * speed
    assert pendulum["tau_j1"][rest] == pytest.approx(by_hand, abs=0.05)  # of derivatives by differences


@pytest.mark.parametrize(
    ("status", "said", "failed", "fault"),
    [
        (0, "", {}, False),
        (2, "Error: too short", {}, False),
        (70, "Error: a fault", {}, True),
        (0, "x.py:1: RuntimeWarning: divide by zero", {}, True),
        (0, "", {"tracking": "KeyError"}, True),
    ],
)
def test_what_counts_as_a_fault(status, said, failed, fault, tmp_path):
    def run(command, **_):
        out = Path(command[command.index("--out") + 1])
        out.mkdir()
        (out / "diagnosis.json").write_text(json.dumps({"verdict": "nothing_missing", "effects": [], "failed": failed}))
        return SimpleNamespace(returncode=status, stderr=said)

    assert awkward.wrong(awkward.outcome(0, tmp_path, run)) == fault
