"""Friction that changes over a session whose recordings are on one clock, read from files as users have them."""

from dataclasses import replace

import numpy as np
import pytest
from recorded import as_set, record

from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import save_recordings

RATIO, SETTLES = 0.9, 120.0  # of all friction at the start, and its time constant [s]


def test_friction_that_decays_over_a_session_is_named_with_its_time_constant(planar, tmp_path):
    """Five recordings of 8 s, of which one begins a minute after the other: none alone shows how long it takes."""
    plant, rng = planar(2), np.random.default_rng(4)
    made = []
    for i in range(5):
        r = record(plant, f"{i}.csv", rng, 8.0, 0.01)
        r = replace(r, t=r.t + 1000.0 + 60.0 * i)
        friction = np.tanh(r.dq / plant.width) + r.dq  # of a plant whose levels are 1
        made.append(replace(r, tau=r.tau + [[0.0], [RATIO]] * np.exp(-(r.t - 1000.0) / SETTLES) * friction))
    save_recordings(as_set(plant, made), tmp_path / "set")
    found = diagnose(load_recordings(tmp_path / "set")).findings
    (term,) = (f.term for f in found)
    assert (term.effect.name, term.effect.joints, term.groups) == ("friction_drift", (1,), ())
    # noise of 1 % of the torque leaves 1 %
    assert term.named == pytest.approx({"ratio": RATIO, "time_constant": SETTLES}, rel=0.03)
