"""Faults of sensors, drivers and files that leave every column possible: each is put into a right set, and told."""

import numpy as np
import pytest
from swung import columns, without, written

from rrr_oc.recordings.faults import cut_off, zeroed
from rrr_oc.recordings.reader import load_recordings

RIGHT = without(("ddq",), columns())
T = RIGHT["t"]
LIMIT = float(np.quantile(np.abs(RIGHT["tau_joint2"]), 0.8))


def frozen(seconds: float) -> dict[str, np.ndarray]:
    """The encoder of joint2 gives its last value from 3 s on; its speed is measured."""
    q = RIGHT["q_joint2"].copy()
    q[(T > 3) & (seconds - 0.005 > T - 3)] = q[T <= 3][-1]
    return RIGHT | {"q_joint2": q}


FAULTS = {
    "joint not listed": (
        RIGHT | {"q_wrist": 0.3 * np.sin(T)},
        "a.csv: q_wrist moves by 34.4° and wrist is not one of the joints listed: the arm is taken as if it stood still at 0°",
    ),
    "joint elsewhere": (
        RIGHT | {"q_wrist": 0.5 + 0 * T},
        'a.csv: q_wrist stands at 28.6°, where the arm is taken to have 0°; "fixed_deg" says another angle',
    ),
    "encoder": (frozen(0.4), "a.csv: q_joint2 is the same from 3.000 to 3.390 s, in which dq_joint2 goes on by "),
    "torque": (
        RIGHT | {"tau_joint2": np.clip(RIGHT["tau_joint2"], -LIMIT, LIMIT)},
        f"a.csv: tau_joint2 is cut off at {LIMIT:.4g} Nm, in up to 20 % of the rows, ",
    ),
}


def notes(folder, **files):
    return load_recordings(written(folder, **files)).notes


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told(tmp_path, fault):
    wrong, said = FAULTS[fault]
    before = notes(tmp_path / "right", a=RIGHT)
    more = [note for note in notes(tmp_path / "wrong", a=wrong) if note not in before and "mean nothing" not in note]
    assert [note.startswith(said) for note in more] == [True]


def test_a_joint_that_is_not_listed_may_stand_where_it_is_held(tmp_path):
    before = notes(tmp_path / "right", a=RIGHT)
    assert not [n for n in notes(tmp_path, a=RIGHT | {"q_wrist": 0 * T}) if n not in before and "q_wrist stands" in n]


def test_a_recording_that_is_there_twice_is_told(tmp_path):
    """Under another name, and with a piece of it alone."""
    other = columns(seconds=11.0)
    other |= {name: values + 0.1 for name, values in other.items() if name.startswith("q_")}
    piece = {name: values[300:] for name, values in RIGHT.items()}
    for second, share in ((RIGHT, 100), (piece, 100)):
        found = notes(tmp_path / f"{len(second['t'])}", a=RIGHT, b=without(("ddq",), other), c=second)
        said = f"c.csv: {share} % of its rows stand in a.csv again; one recording must not be there twice"
        assert [n for n in found if "twice" in n] == [said]


@pytest.mark.parametrize("levels", [100, 1000, None])
def test_no_motion_is_cut_off_whatever_its_resolution(levels):
    t = np.arange(0, 20, 0.01)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        torque = sum(
            a * np.sin(w * t + p)
            for a, w, p in zip(rng.normal(size=4), rng.uniform(0.5, 5, 4), rng.uniform(0, 6, 4), strict=True)
        )
        torque = np.asarray(torque) / np.max(np.abs(torque))
        step = lambda x: x if levels is None else np.round(x * levels) / levels  # noqa: E731
        assert not cut_off(step(torque)).any()
        found = cut_off(step(np.clip(torque, -0.6, 0.6)))
        assert found.any()
        np.testing.assert_array_equal(found, np.abs(step(torque)) >= 0.6)


@pytest.mark.parametrize("levels", [30, 1000, None])
def test_a_dead_band_is_found_and_zeros_of_a_coarse_torque_are_none(levels):
    t, rng = np.arange(0, 20, 0.01), np.random.default_rng(3)
    torque = np.sin(t) + 0.4 * np.sin(2.3 * t + 1) + 0.001 * rng.standard_normal(t.size)
    read = torque if levels is None else np.round(torque * levels) / levels
    assert not zeroed(read).any()
    dead = np.where(np.abs(read) < 0.2, 0.0, read)
    np.testing.assert_array_equal(zeroed(dead), dead == 0)


def test_an_encoder_that_stands_still_until_it_jumps_is_left_out(tmp_path):
    """Whether speeds are measured or not; of all joints at once, as when a bus hangs."""
    stands = (T > 5) & (T < 5.995)
    hangs = {name: np.where(stands, x[T <= 5][-1], x) if name != "t" else x for name, x in RIGHT.items()}
    for wrong, right in ((frozen(1.0), (T <= 3.005) | (T >= 3.995)), (hangs, ~stands)):
        for kinds in ((), ("dq",)):
            (r,) = load_recordings(written(tmp_path, a=without(kinds, wrong))).recordings
            expected = np.array([RIGHT[f"q_joint{j}"][right] for j in (1, 2, 3)])
            assert r.q.shape[1] == pytest.approx(np.sum(right), abs=1)
            assert all(np.min(np.abs(expected[1] - q)) < 1e-9 for q in r.q[1])
            assert any("q_joint2 stands still until it jumps" in text for text in r.mended.values())


def test_numbers_that_stand_for_no_value_are_left_out(tmp_path):
    """Every 17th position is 0, every 13th torque -999 or 200 Nm too much."""
    for name, every, value in (("q_joint2", 17, 0.0), ("tau_joint2", 13, -999.0), ("tau_joint2", 13, 200.0)):
        wrong = RIGHT[name].copy()
        wrong[::every] = value
        wrong[0] = RIGHT[name][0]
        (r,) = load_recordings(written(tmp_path, a=RIGHT | {name: wrong})).recordings
        kept = np.flatnonzero(np.isin(T, r.t))
        assert set(kept) == set(np.flatnonzero(wrong == RIGHT[name])), name


def test_torques_without_their_sign_are_told(tmp_path):
    said = "tau_joint2 is 0 or above wherever joint2 moves to; is it a magnitude, without its sign?"
    for tau in (np.abs(RIGHT["tau_joint2"]), RIGHT["tau_joint2"], 20 + np.abs(RIGHT["tau_joint2"])):
        magnitude = tau is not RIGHT["tau_joint2"] and np.min(tau) < 1
        assert (said in notes(tmp_path, a=RIGHT | {"tau_joint2": tau})) == magnitude
