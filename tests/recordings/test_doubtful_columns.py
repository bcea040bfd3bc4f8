"""Recordings whose rates are none, or whose times, torques and travel look wrong: what is used, and what is said."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from swung import JOINTS, PLANT, columns, without, written

from rrr_oc.calibration.calibrate import calibrate
from rrr_oc.errors import UserError
from rrr_oc.recordings.reader import load_recordings


@pytest.fixture
def load(tmp_path):
    return lambda **files: load_recordings(written(tmp_path, **files))


WRONG = {
    "speeds are zero": ("dq", 0.0, "dq_joint2 is 0 times the derivative of q_joint2"),
    "accelerations are zero": ("ddq", 0.0, "ddq_joint2 is 0 times the derivative of dq_joint2"),
    "speeds of the motors": ("dq", 50.0, "dq_joint2 is 50 times the derivative of q_joint2"),
    "speeds twice as large": ("dq", 2.0, "dq_joint2 is 2 times the derivative of q_joint2"),
    "speeds of motors that turn the other way": ("dq", -50.0, None),
}


@pytest.mark.parametrize(("kind", "factor", "said"), WRONG.values(), ids=WRONG)
def test_rates_that_are_none_are_not_used(load, kind, factor, said):
    """As if their columns were not there; friction is that of the plant."""
    right = columns() if kind == "ddq" else without(("ddq",), columns())
    wrong = right | {name: factor * values for name, values in right.items() if name.startswith(f"{kind}_")}
    if said is None:
        with pytest.raises(UserError, match="dq_joint1' is minus the derivative of 'q_joint1'; one of them has the wrong sign"):
            load(a=wrong)
        return
    found = load(a=wrong, b={name: values[:-50] for name, values in wrong.items()})
    (note,) = (note for note in found.notes if "stand in a.csv again" not in note)  # of b, which is a without its end
    assert note.startswith("a.csv and 1 more: ")
    assert said in note
    assert note.endswith("; derivatives take their place")
    expected = load(a=without((kind,), right)).recordings[0]
    np.testing.assert_array_equal(found.recordings[0].dq, expected.dq)
    np.testing.assert_array_equal(found.recordings[0].ddq, expected.ddq)
    friction = [e.value for term in calibrate(found).terms if "viscous" in term.effect.name for e in term.estimates]
    np.testing.assert_allclose(friction, PLANT.viscous, rtol=0.05)  # noise and smoothing


def test_rates_are_used_where_they_are_better_than_derivatives(load):
    """Noisy, coarse, late, early, and right ones; positions in steps of 0.001 rad, of which derivatives have noise of 0.01 rad/s."""
    right, rng = without(("ddq",), columns()), np.random.default_rng(1)
    t, names = right["t"], [f"dq_{joint}" for joint in JOINTS]
    spoilt = {
        "": (lambda x: x + rng.normal(0, np.std(x), x.shape), False),
        " ": (lambda x: np.round(x, 0), False),
        "comes 6 ms later": (lambda x: np.interp(t - 0.006, t, x), True),
        "comes 40 ms later": (lambda x: np.roll(x, 4), False),
        "comes 10 ms earlier": (lambda x: np.roll(x, -1), True),
        "no note": (lambda x: x, True),
    }
    for said, (spoil, used) in spoilt.items():
        spoiled = {n: spoil(v) if n.startswith("dq") else np.round(v, 3) if n.startswith("q") else v for n, v in right.items()}
        found = load(a=spoiled)
        (recording,) = found.recordings
        assert [rate.used for rate in recording.rates] == [used] * 3, said
        assert set(names).isdisjoint(recording.computed) == used, said
        assert not found.notes if said == "no note" else said.strip() in " ".join(found.notes)
        # of the steps of positions; rates that are moved are linear between samples, and held at the ends
        inside = slice(10, -10)
        np.testing.assert_allclose(recording.dq[:, inside], [right[n][inside] for n in names], atol=0.01 if used else 0.05)


def test_rows_without_a_speed_are_kept(load):
    """Drivers leave speeds out of some messages; a column without any number is none."""
    right = without(("ddq",), columns())
    spoiled = {name: np.array(values) for name, values in right.items()}
    spoiled["dq_joint1"][100:500:2] = np.nan
    spoiled["dq_joint3"][:] = np.nan
    found = load(a=spoiled)
    (recording,) = found.recordings
    assert (recording.dropped, recording.computed) == (0, ("dq_joint3", "ddq_joint1", "ddq_joint2", "ddq_joint3"))
    assert "a.csv: dq_joint1 is missing in 200 of 1200 rows, where the derivative takes its place" in found.notes
    truth = np.array([right[f"dq_{joint}"] for joint in JOINTS])
    np.testing.assert_array_equal(recording.dq[0, 101:500:2], truth[0, 101:500:2])
    np.testing.assert_allclose(recording.dq, truth, atol=0.02)  # bias of the filter at 2.7 · 2.3 rad/s
    spoiled["tau_joint2"][7] = np.nan
    assert load(a=spoiled).recordings[0].dropped == 1


def notes_of(load, change) -> str:
    right = without(("dq", "ddq"), columns())
    assert load(a=right).notes == ()
    return " ".join(load(a=change(right)).notes)


def test_what_looks_wrong_is_said_once(load):
    slow = {name: values[::25] for name, values in without(("dq", "ddq"), columns(60.0)).items()}
    assert "a.csv: is sampled at 4 Hz; accelerations need 20 Hz or more" in notes_of(load, lambda _: slow)
    gap = "a.csv: has a gap of 4 s; 4 of 12 s are missing, and no derivative crosses a gap"
    assert gap in notes_of(load, lambda right: {name: np.delete(v, np.s_[401:800]) for name, v in right.items()})
    flat = notes_of(load, lambda right: right | {"tau_joint2": 0 * right["t"]})
    assert "a.csv: the recorded torque of joint2 never changes; was it recorded?" in flat
    degrees = {f"q_{joint}": np.pi / 180 for joint in JOINTS}
    small = notes_of(load, lambda right: {n: v * degrees.get(n, 1.0) for n, v in right.items()})
    assert "no joint travels more than 1.48°; were angles in rad taken for degrees?" in small


def test_a_recording_of_zeros_is_refused(load):
    right = without(("dq", "ddq"), columns())
    for value, said in ((0.0, "are 0 in every row"), (0.5, "are the same in every row")):
        with pytest.raises(UserError, match=rf"b\.csv: all positions and torques {said}; nothing was recorded"):
            load(a=right, b={name: v if name == "t" else 0 * v + value for name, v in right.items()})


def test_stamps_of_batches_are_spread(load):
    """Four samples at a time, with one stamp or a microsecond apart; then some samples are lost."""
    right = without(("dq", "ddq"), columns())
    t = right["t"]
    last = np.minimum((np.arange(len(t)) // 4) * 4 + 3, len(t) - 1)
    for apart in (0.0, 1e-6):
        found = load(a=right | {"t": t[last] + apart * (np.arange(len(t)) % 4)})
        assert found.notes == ("a.csv: samples are stamped in batches of 4; their times are spread",)
        np.testing.assert_allclose(found.recordings[0].t, t, atol=1e-3)
    lost = np.sort(np.random.default_rng(4).choice(len(t), len(t) - 30, replace=False))
    some = {name: values[lost] for name, values in right.items()}
    batch = lost // 4
    handed = t[lost][np.searchsorted(batch, batch, "right") - 1]  # the time of a batch's last sample that arrived
    (recording,) = load(a=some | {"t": handed + 1e-6 * (lost % 4)}).recordings
    known = np.isin(np.round(100 * t[lost]), np.round(100 * recording.t))
    assert recording.dropped == np.sum(~known) <= 3 * 30  # of a batch that lost one, the last sample's time alone is known
    np.testing.assert_allclose(recording.t, t[lost][known], atol=1e-4)


def test_stamps_that_jitter_are_evened(load):
    """Where samples are even and stamps are late by chance, also if some are lost; not where the sampling itself is uneven."""
    right, rng = without(("dq", "ddq"), columns()), np.random.default_rng(5)
    t = right["t"]
    kept = np.sort(rng.choice(len(t), len(t) - 30, replace=False))
    late = t + rng.uniform(0, 0.004, len(t))
    found = load(a={name: values[kept] for name, values in (right | {"t": late}).items()})
    np.testing.assert_allclose(found.recordings[0].t - t[kept], 0.002, atol=2e-4)
    assert "a.csv: stamps jitter by 1.1 ms about even times, at which positions are smoother; these are used" in found.notes
    uneven = {name: CubicSpline(t, values)(late[:-1]) for name, values in right.items()}
    found = load(a=uneven)
    np.testing.assert_array_equal(found.recordings[0].t, uneven["t"])
    assert found.notes == ()


def test_positions_that_are_repeated_until_the_next_update_have_none_of_the_steps(load):
    """Updates at 60 Hz in rows at 100 Hz, of an encoder of 16 bit; rows in which each position is new are not touched."""
    right = without(("dq", "ddq"), columns())
    t, step = right["t"], 2 * np.pi / 2**16
    updated = np.floor(60 * t + 1e-9) / 60
    spoilt, exact = dict(right), dict(right)
    for joint in JOINTS:
        exact[f"q_{joint}"] = np.round(right[f"q_{joint}"] / step) * step
        spoilt[f"q_{joint}"] = np.round(CubicSpline(t, right[f"q_{joint}"])(updated) / step) * step
    found = load(a=spoilt)
    assert found.notes == (
        "a.csv: positions are updated every 16.7 ms and repeated until then; a spline through the updates is used",
    )
    late = (t[:, None] - np.linspace(0, 0.01, 21)).T  # by how much is not known
    for joint, q in zip(JOINTS, found.recordings[0].q, strict=True):
        inside = slice(10, -10)
        true = CubicSpline(t, right[f"q_{joint}"])
        assert (
            min(np.max(np.abs(true(x) - q)[inside]) for x in late)
            < 1.5e-3
            < np.max(np.abs(right[f"q_{joint}"] - spoilt[f"q_{joint}"]))
        )
    assert load(a=exact).notes == ()


def test_positions_that_jump_away_and_back_are_left_out(load):
    """Bits read wrongly, also two samples in a row; and no fast motion, coarse encoder or whole turn is taken for one."""
    right = without(("dq", "ddq"), columns())
    spoilt = right["q_joint2"].copy()
    spoilt[[100, 500, 501, 900]] += np.array([0.2, -0.3, -0.3, 1.0])
    found = load(a=right | {"q_joint2": spoilt})
    assert "a.csv: q_joint2 jumps away and back in 4 rows, which are left out" in found.notes
    np.testing.assert_allclose(found.recordings[0].q[1], np.delete(right["q_joint2"], [100, 500, 501, 900]), atol=1e-9)
    for step in (1e-6, 2e-3, 2e-2):
        coarse = right | {f"q_{joint}": np.round(right[f"q_{joint}"] / step) * step for joint in JOINTS}
        assert not load(a=coarse).recordings[0].mended
    turned = right | {"q_joint2": np.where(right["t"] > 5, right["q_joint2"] + 2 * np.pi, right["q_joint2"])}
    assert not load(a=turned).recordings[0].mended


@pytest.mark.parametrize("fault", ["cut off", "jitter", "repeated"])
def test_faults_of_loggers_leave_the_calibration_as_it_is(load, fault):
    """Viscous friction and rotors are those of the plant."""
    right = without(("dq", "ddq"), columns(20.0))
    t, spoilt = right["t"], dict(right)
    if fault == "cut off":
        limit = 0.7 * np.max(np.abs(right["tau_joint2"]))
        spoilt["tau_joint2"] = np.clip(right["tau_joint2"], -limit, limit)
    elif fault == "jitter":
        spoilt["t"] = t + np.random.default_rng(2).uniform(0, 0.005, len(t))
    else:
        updated = np.floor(60 * t + 1e-9) / 60
        spoilt |= {f"q_{joint}": CubicSpline(t, right[f"q_{joint}"])(updated) for joint in JOINTS}
    model = calibrate(load(a=spoilt))
    rotors, friction = (
        [e.value for term in model.terms if term.effect.name == name for e in term.estimates]
        for name in ("armature", "viscous_friction")
    )
    np.testing.assert_allclose(friction, PLANT.viscous, rtol=0.06)
    np.testing.assert_allclose(rotors, PLANT.armature, atol=0.03)


def test_signals_of_other_rates_and_times_are_read_at_all_rows(load):
    """Positions and torques in turn, as of messages that were merged; torques at a fifth of the rate; and rows marked as wrong stay out."""
    right = without(("dq", "ddq"), columns())
    number = np.arange(len(right["t"]))
    torque = {name for name in right if name.startswith("tau_")}
    for kept in (number % 2, number % 5 == 0):
        spoilt = {name: np.where(kept == (name in torque), x, np.nan) if name != "t" else x for name, x in right.items()}
        spoilt = {name: right[name] if name[:2] == "q_" and kept.dtype == bool else x for name, x in spoilt.items()}
        found = load(a=spoilt)
        (r,) = found.recordings
        assert any("are sampled at times of their own" in note for note in found.notes)
        assert len(r.t) > len(number) - 10
        at = np.searchsorted(right["t"], r.t)
        np.testing.assert_allclose(r.q, [right[f"q_{joint}"][at] for joint in JOINTS], atol=1e-5)
    wrong = {
        name: np.where((number > 200) & (number < 900), np.nan, x) if name == "tau_joint2" else x for name, x in right.items()
    }
    assert load(a=wrong).recordings[0].dropped == 699


def test_rows_that_stand_there_again_are_left_out(load):
    found = load(a={name: np.repeat(x, 2) for name, x in without(("dq", "ddq"), columns()).items()})
    assert "a.csv: 1200 rows stand there again and are left out" in found.notes
    assert len(found.recordings[0].t) == 1200


def test_zeros_before_a_logger_starts_are_left_out_and_a_motion_that_stops_is_not(load):
    """A logger that has zeros at first, and a motion that stops for 4 s."""
    right = without(("dq", "ddq"), columns())
    t = right["t"]
    found = load(a={name: x if name == "t" else np.where(t < 0.2, 0.0, x) for name, x in right.items()})
    assert found.recordings[0].segments == (slice(0, 1180),)
    assert found.recordings[0].t[0] == pytest.approx(0.2)
    assert any("stands still until it jumps" in note for note in found.notes)
    stopped = np.interp(t, [0, 4, 8, 12], [0, 4, 4, 8])
    still = {name: x if name == "t" else CubicSpline(t, x)(stopped) for name, x in right.items()}
    assert not load(a=still).recordings[0].mended
