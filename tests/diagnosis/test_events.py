"""Events beside missing physics: errors against those of like states at other times, and of the same time in other recordings."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, multisine, record

from rrr_oc.diagnosis.events import events
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.effects.priors import Priors

COUNT, SECONDS = 4, 15.0
PUSHES = [("0.csv", 3.1), ("0.csv", 9.4), ("1.csv", 5.2), ("2.csv", 7.7), ("3.csv", 11.6)]  # [s]


def told(recordings):
    """The events in the error of the plain fit."""
    _, fitter, _, plain = ready(recordings, Priors())
    return events(fitter.begin(plain))


def sticking(dq):
    """Friction in a shape that no plain model has [Nm]: the plain fit leaves some tenths of a Nm all the time."""
    return 1.2 * np.tanh(dq / 0.05) * np.exp(-(((np.abs(dq) - 0.6) / 0.25) ** 2))


@pytest.mark.parametrize("wrong", [False, True])
def test_pushes_are_found_with_their_times_though_friction_is_wrong_in_shape(planar, wrong):
    plant, rng = planar(1), np.random.default_rng(6)
    made = [record(plant, f"{i}.csv", rng, SECONDS, 0.01) for i in range(COUNT)]
    there = [replace(r, tau=r.tau + wrong * sticking(r.dq)) for r in made]
    pushed = [replace(r, tau=r.tau + 3.0 * sum(np.abs(r.t - t) < 0.1 for file, t in PUSHES if file == r.file)) for r in there]
    assert told(as_set(plant, there)) == []
    found = told(as_set(plant, pushed))
    assert [e.recording for e in found] == [file for file, _ in PUSHES]
    assert all(e.begin < t < e.end < e.begin + 1 for e, (_, t) in zip(found, PUSHES, strict=True))


@pytest.mark.parametrize("every", [False, True])
def test_what_comes_again_with_the_motion_of_each_recording_is_no_event(planar, every):
    """The same motion each time, with a stroke at the same time of one or of all: that of one is an event."""
    plant, rng = planar(1), np.random.default_rng(7)
    motion = multisine(1, np.arange(round(100 * SECONDS)) / 100, rng)
    made = [record(plant, f"{i}.csv", rng, SECONDS, 0.01, motion) for i in range(COUNT)]
    struck = [replace(r, tau=r.tau + 3.0 * (np.abs(r.t - 6.0) < 0.1) * (every or i == 2)) for i, r in enumerate(made)]
    assert [e.recording for e in told(as_set(plant, struck))] == ([] if every else ["2.csv"])


def test_friction_that_sticks_where_a_joint_turns_is_no_event_and_more_than_that_is(planar):
    """At some turns friction is another one within its level of 1 Nm, as where a joint rests for a moment; once 4 Nm more act there."""
    plant, rng = planar(1), np.random.default_rng(11)
    made = [record(plant, f"{i}.csv", rng, SECONDS, 0.01) for i in range(COUNT)]
    turns = [np.flatnonzero(np.diff(np.sign(r.dq[0])))[2::3] for r in made]
    near = [np.min(np.abs(np.arange(len(r.t))[:, None] - k), axis=1) < 8 for r, k in zip(made, turns, strict=True)]
    stuck = [replace(r, tau=r.tau + 0.9 * at) for r, at in zip(made, near, strict=True)]
    assert told(as_set(plant, stuck)) == []
    at = float(made[1].t[turns[1][0]])
    pushed = [replace(r, tau=r.tau + 4.0 * (i == 1) * (np.abs(r.t - at) < 0.1)) for i, r in enumerate(stuck)]
    assert [e.recording for e in told(as_set(plant, pushed)) if e.begin < at < e.end] == ["1.csv"]


@pytest.mark.parametrize("seed", [5, 7])
def test_a_spring_that_is_seldom_taut_is_no_push(planar, seed):
    """A cable across both joints that pulls for a tenth of the time [Nm/rad], in strokes that look like pushes to a plain model."""
    plant, rng = planar(2), np.random.default_rng(seed)
    made = [record(plant, f"{i}.csv", rng, 12.0, 0.005) for i in range(COUNT)]
    stretch = [-r.q[0] - 0.5 * r.q[1] for r in made]
    slack = float(np.quantile(np.concatenate(stretch), 0.9))
    pulls = [6.0 * np.maximum(s - slack, 0.0) for s in stretch]
    recordings = as_set(plant, [replace(r, tau=r.tau - np.array([p, 0.5 * p])) for r, p in zip(made, pulls, strict=True)])
    assert told(recordings)
    diagnosis = diagnose(recordings)
    assert not diagnosis.events
    (spring,) = diagnosis.findings
    assert (spring.term.effect.name, spring.term.recordings) == ("biarticular_spring", "all")
    assert spring.term.values == pytest.approx([6.0, 0.5, slack], rel=0.01)
