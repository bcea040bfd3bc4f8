"""The reader and writer of recording sets: the contract's keys and defaults, every way to be wrong, and exact round trips."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from recorded import real
from scipy.signal import savgol_filter

from rrr_oc.effects.elastic.biarticular_spring import BiarticularSpring
from rrr_oc.effects.elastic.parallel_spring import ParallelSpring
from rrr_oc.errors import UserError
from rrr_oc.numerics.savitzky_golay import differentiate, local_polynomial, smooth, split
from rrr_oc.recordings import plausibility
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.storage import check_file, check_folder, new_folder, write_csv, write_json, write_npz, write_text

JOINTS = ("joint1", "joint2", "joint3")
EXAMPLE = {  # as printed in the contract
    "format": "rrr_oc-recordings/1",
    "robot": "rrr",
    "joints": ["joint1", "joint2", "joint3"],
    "torque": "motor",
    "inertial": "nominal",
    "gravity": [0, 0, -9.81],
    "tool": {"link": "link3", "position": [0.3, 0, 0]},
    "actuators": {"joint2": {"torque_constant": 12.34}},
    "recordings": [
        {"file": "sweep1.csv", "springs": {}},
        {
            "file": "sweep2.csv",
            "payload": 5.0,
            "springs": {
                "pea": {"joint2": {"stiffness_Nm_per_rad": 13.705, "equilibrium_rad": 1.92, "active": "below"}},
                "bpea": {
                    "stiffness_Nm_per_rad": 10.97,
                    "equilibrium_rad": -1.16,
                    "radius1_m": 0.015,
                    "radius2_m": 0.036,
                    "radius3_m": 0.014,
                    "joints": ["joint2", "joint3"],
                },
            },
        },
    ],
}
ONE = {"format": "rrr_oc-recordings/1", "robot": "rrr", "joints": list(JOINTS), "recordings": [{"file": "a.csv"}]}


def motion(t):
    """Columns of a smooth motion that `rrr` can make, at times t [s]."""
    phase = np.array([0.0, 0.4, 0.9])[:, None]
    q = np.array([0.0, 1.0, -1.0])[:, None] + 0.4 * np.sin(5 * t + phase)
    columns = {"t": t, **dict(zip((f"q_{j}" for j in JOINTS), q, strict=True))}
    return columns | {f"tau_{j}": 3.0 * np.cos(2 * t + k) for k, j in enumerate(JOINTS)}


def csv(columns):
    rows = zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True)
    return ",".join(columns) + "\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows)


@pytest.fixture
def write(tmp_path):
    def write(header=ONE, **files):
        text = header if isinstance(header, str) else json.dumps(header)
        (tmp_path / "recordings.json").write_text(text)
        for name, content in (files or {"a": motion(np.arange(100) * 0.01)}).items():
            data = content if isinstance(content, bytes) else (content if isinstance(content, str) else csv(content)).encode()
            (tmp_path / f"{name}.csv").write_bytes(data)
        return tmp_path

    return write


def refused(folder):
    with pytest.raises(UserError) as caught:
        load_recordings(folder)
    return str(caught.value)


def test_the_contracts_example(write):
    t = np.arange(0.0, 2.0, 0.01)
    found = load_recordings(write(EXAMPLE, sweep1=motion(t), sweep2=motion(t)))
    first, second = found.recordings
    assert found.joints == JOINTS
    assert (found.torque, found.inertial) == ("motor", "nominal")
    assert found.torque_constant == (None, 12.34, None)
    assert (found.tool.joint, found.tool.position.tolist()) == (2, [0.3, 0.0, 0.0])
    assert first.springs == ()
    assert not first.payload.any()
    assert first.group == "sweep1.csv"
    assert np.all(second.payload == 5.0)
    (pea, pea_theta), (bpea, bpea_theta) = second.springs
    assert pea == ParallelSpring((1,), active="below")
    assert pea_theta == {"stiffness": 13.705, "equilibrium": 1.92}
    assert bpea == BiarticularSpring((1, 2), pulleys=0.015 / 0.036)
    expected = {"kappa": 10.97 * (36 / 15) ** 2, "rho": 14 / 36, "phi": -1.16 * 15 / 36}
    assert bpea_theta == pytest.approx(expected, rel=1e-12)  # rounding


def test_defaults(write):
    found = load_recordings(write() / "recordings.json")
    assert (found.torque, found.inertial, found.gravity.tolist()) == ("motor", "nominal", [0.0, 0.0, -9.81])
    assert found.tool.joint == 2
    assert found.torque_constant == (None, None, None)
    assert found.recordings[0].computed == tuple(f"{kind}_{joint}" for kind in ("dq", "ddq") for joint in JOINTS)


SESSION = {"a": 100.0, "b": 40.0, "c": 160.0}  # when files of 2 s begin [s]


@pytest.mark.parametrize("order", ["abc", "bac", "cba"])
def test_files_whose_times_do_not_overlap_are_on_one_clock(write, order):
    """It begins with the first of all, in whatever order they are listed, which stays."""
    header = ONE | {"recordings": [{"file": f"{name}.csv"} for name in order]}
    found = load_recordings(write(header, **{name: motion(SESSION[name] + np.arange(0.0, 2.0, 0.01)) for name in order}))
    assert [r.file for r in found.recordings] == [f"{name}.csv" for name in order]
    assert [r.start for r in found.recordings] == [40.0] * 3
    for name, r in zip(order, found.recordings, strict=True):
        np.testing.assert_allclose(r.clock, SESSION[name] - 40.0 + np.arange(0.0, 2.0, 0.01), atol=1e-9)


@pytest.mark.parametrize("order", ["abc", "bac", "cba"])
@pytest.mark.parametrize("other", [0.0, 1.99, 159.0])
def test_files_whose_times_overlap_have_a_clock_each(write, order, other):
    """One of three is enough, even by the last of its samples: times that each begin at 0 are not those of a session."""
    begins = {"a": 0.0, "b": other, "c": 160.0}
    header = ONE | {"recordings": [{"file": f"{name}.csv"} for name in order]}
    found = load_recordings(write(header, **{name: motion(begins[name] + np.arange(0.0, 2.0, 0.01)) for name in order}))
    assert [r.start for r in found.recordings] == [None] * 3
    assert [r.clock[0] for r in found.recordings] == [0.0] * 3


def test_robot_from_a_urdf_and_overridden(write):
    urdf = '<robot name="a"><link name="base"/><link name="arm"/><joint name="joint1" type="revolute"><parent link="base"/>'
    urdf += '<child link="arm"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="5" velocity="9"/></joint></robot>'
    t = np.arange(100) * 0.01
    folder = write({**ONE, "robot": "sub/rrr", "joints": ["joint1"], "inertial": "identify"}, a=motion(t))
    (folder / "sub").mkdir()
    (folder / "sub/rrr").write_text(urdf)
    assert load_recordings(folder).joints == ("joint1",)
    assert load_recordings(folder, robot="rrr_prototype").robot.name == "rrr_prototype"
    save_recordings(load_recordings(folder), folder / "copy")
    copy = load_recordings(folder / "copy")  # a URDF with a bundled model's name stays that URDF
    assert (copy.robot.name, copy.robot.links, copy.source) == ("rrr", ("arm",), folder / "copy" / "rrr.urdf")


def test_currents_become_torques(write):
    columns = {name.replace("tau", "current"): values for name, values in motion(np.arange(50) * 0.01).items()}
    constants = {joint: {"torque_constant": k} for joint, k in zip(JOINTS, (10.89, 12.34, -10.89), strict=True)}
    found = load_recordings(write({**ONE, "torque": "current", "actuators": constants}, a=columns))
    recording = found.recordings[0]
    np.testing.assert_array_equal(recording.tau[1], columns["current_joint2"])
    np.testing.assert_array_equal(found.output_torque(recording)[2], -10.89 * columns["current_joint3"])


def test_keys_may_be_spelled_as_in_tasks(write):
    recordings = load_recordings(write(ONE | {"recordings": [{"file": "a.csv", "payload_kg": 2.0}]}))
    assert recordings.recordings[0].payload.max() == 2.0


def test_payload_column_overrides(write):
    columns = motion(np.arange(50) * 0.01)
    columns["payload"] = np.linspace(0, 2, 50)
    found = load_recordings(write({**ONE, "recordings": [{"file": "a.csv", "payload": 9.0}]}, a=columns))
    np.testing.assert_array_equal(found.recordings[0].payload, columns["payload"])


def test_springs_of_all_kinds(write):
    pulleys = {"radius1_m": 0.02, "radius2_m": 0.02, "radius3_m": 0.0}
    bpea = {"stiffness_Nm_per_rad": 2.0, "equilibrium_rad": 0.5, **pulleys}
    springs = {
        "pea": {"joint1": {"stiffness_Nm_per_rad": 1, "equilibrium_rad": 0, "active": "above"}},
        "bpea": [bpea, {**bpea, "joints": ["joint1", "joint3"], "winding": [1.0, -1]}],
    }
    found = load_recordings(write({**ONE, "recordings": [{"file": "a.csv", "springs": springs, "group": "g"}]}))
    effects = [effect for effect, _ in found.recordings[0].springs]
    assert effects == [
        ParallelSpring((0,), active="above"),
        BiarticularSpring((1, 2)),
        BiarticularSpring((0, 2), winding=(1, -1)),
    ]


def test_nan_rows_are_dropped_and_counted(write):
    columns = motion(np.arange(100) * 0.01)
    columns["tau_joint2"][[3, 50]] = np.nan
    columns["q_joint1"][3] = np.nan
    recording = load_recordings(write(a=columns)).recordings[0]
    assert (recording.dropped, len(recording.t), recording.q.shape) == (2, 98, (3, 98))
    assert len(recording.segments) == 1  # a step of two medians is no gap


def test_gaps_split_and_short_pieces_are_dropped(write):
    t = np.concatenate([np.arange(60) * 0.01, 1.0 + np.arange(3) * 0.01, 2.0 + np.arange(6) * 0.01])
    recording = load_recordings(write(a=motion(t))).recordings[0]
    assert recording.segments == (slice(0, 60), slice(60, 66))
    assert recording.short == 3
    assert recording.t[60] == 2.0
    columns = motion(t)
    phase = np.array([0.0, 0.4, 0.9])[:, None]
    for kind, rates in (("dq", 2 * np.cos(5 * t + phase)), ("ddq", -10 * np.sin(5 * t + phase))):
        columns |= {f"{kind}_{joint}": rates[i] for i, joint in enumerate(JOINTS)}
    kept = load_recordings(write(a=columns)).recordings[0]
    assert (kept.short, len(kept.segments), kept.computed) == (0, 3, ())


def test_derivatives_do_not_cross_a_gap(write):
    t = np.concatenate([np.arange(100) * 0.01, 5.0 + np.arange(100) * 0.01])
    columns = motion(t)
    columns["q_joint1"] = np.where(t < 2, 0.3 * t, 1.0)
    recording = load_recordings(write(a=columns)).recordings[0]
    expected = np.where(recording.t < 2, 0.3, 0.0)
    np.testing.assert_allclose(recording.dq[0], expected, atol=1e-12)  # polynomials reproduce lines to rounding
    np.testing.assert_allclose(recording.ddq[0], 0, atol=1e-9)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_derivatives_of_an_analytic_signal(write, jitter):
    rng = np.random.default_rng(1)
    t = np.arange(500) * 0.005 + jitter * 0.005 * rng.uniform(-1, 1, 500)
    recording = load_recordings(write(a=motion(t))).recordings[0]
    inside = (t > 0.1) & (t < t[-1] - 0.1)
    phase = np.array([0.0, 0.4, 0.9])[:, None]
    dq, ddq = 2.0 * np.cos(5 * t + phase), -10.0 * np.sin(5 * t + phase)
    # bias of order (ω h)⁴ with ω h = 5 · 0.075: cubic h⁴ f⁽⁵⁾ 3/280, quartic h⁴ f⁽⁶⁾ 1/216
    np.testing.assert_allclose(recording.dq[:, inside], dq[:, inside], atol=1e-3 * 2)
    np.testing.assert_allclose(recording.ddq[:, inside], ddq[:, inside], atol=1e-3 * 10)


def test_acceleration_comes_from_a_measured_speed(write):
    t = np.arange(200) * 0.005
    columns = motion(t) | {"dq_joint1": 2.0 * np.cos(5 * t) + 0.01 * t**2}
    recording = load_recordings(write(a=columns)).recordings[0]
    assert recording.computed == ("dq_joint2", "dq_joint3", "ddq_joint1", "ddq_joint2", "ddq_joint3")
    np.testing.assert_allclose(recording.ddq[0], differentiate(t, columns["dq_joint1"][None], [slice(0, 200)])[0])


@pytest.mark.parametrize(("count", "order", "derivative"), [(7, 3, 1), (31, 3, 0), (31, 4, 2), (151, 4, 2), (999, 3, 1)])
def test_local_polynomial_is_savitzky_golay_on_uniform_times(count, order, derivative):
    x = np.random.default_rng(2).normal(size=(2, 1000))
    expected = np.asarray(savgol_filter(x, count, order, deriv=derivative, delta=1.0, mode="interp"))
    found = local_polynomial(np.arange(1000.0), x, derivative, order, count)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())  # conditioning of the normal equations


@pytest.mark.parametrize("rows", [5, 8, 40, 300])
def test_local_polynomial_is_least_squares_on_any_times(rows):
    rng = np.random.default_rng(rows)
    t, x, count, order = np.cumsum(rng.uniform(0.2, 1.8, rows)), rng.normal(size=(1, rows)), 5, 2
    expected = []
    for i in range(rows):
        s = slice(start := min(max(i - 2, 0), rows - count), start + count)
        expected.append(np.linalg.lstsq(np.vander(t[s] - t[i], order + 1, increasing=True), x[0, s], rcond=None)[0][1])
    found = local_polynomial(t, x, 1, order, count)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)  # normal equations against an SVD


def test_split_and_smooth():
    t = np.concatenate([np.arange(400) * 0.01, [9.0, 9.01]])
    assert split(t) == (slice(0, 400), slice(400, 402))
    assert split(t[:1]) == (slice(0, 1),)
    x = (t**3)[None]
    np.testing.assert_allclose(smooth(t, x, split(t)), x, atol=1e-9)  # cubics pass a filter of order 3


def test_round_trip_is_exact(write, tmp_path):
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.009, 0.011, 120)) + (np.arange(120) > 70)
    columns = motion(t)
    columns["dq_joint1"] = 2 * np.cos(5 * t) + rng.normal(size=120)
    columns["payload"] = np.where(t > 0.5, 1 / 3, 0.0)
    columns["tau_joint1"][5] = np.nan
    original = load_recordings(write(EXAMPLE, sweep1=motion(t), sweep2=columns))
    save_recordings(original, tmp_path / "new" / "copy")
    copy = load_recordings(tmp_path / "new" / "copy")
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["copy"]  # nothing temporary is left
    assert (copy.joints, copy.torque, copy.inertial, copy.torque_constant) == (
        original.joints,
        original.torque,
        original.inertial,
        original.torque_constant,
    )
    np.testing.assert_array_equal(copy.tool.position, original.tool.position)
    for a, b in zip(original.recordings, copy.recordings, strict=True):
        for field in fields(a):
            if field.name == "springs":  # stiffness and equilibrium go over to hardware and back, with its rounding
                for (kind, theta), (copied, other) in zip(a.springs, b.springs, strict=True):
                    assert copied.joints == kind.joints
                    assert other == pytest.approx(theta, rel=1e-14)
            elif field.name not in ("dropped", "rates"):  # a row with a NaN, and rates that are not used, are not written again
                np.testing.assert_equal(getattr(b, field.name), getattr(a, field.name), err_msg=field.name)


def test_saving_is_whole_or_not_at_all(write, tmp_path):
    original = load_recordings(write())
    with pytest.raises(UserError, match="exists already"):
        save_recordings(original, tmp_path)
    spoiled = replace(original.recordings[0], tau=np.full((3, 100), np.inf))
    with pytest.raises(UserError, match="infinite") as caught:
        save_recordings(replace(original, recordings=(spoiled,)), tmp_path / "out")
    assert ".tmp" not in str(caught.value)
    assert not [p for p in tmp_path.iterdir() if "out" in p.name]


def test_files_are_whole_or_not_there(tmp_path):
    write_json(tmp_path / "sub" / "a.json", {"x": 0.1, "q̈": None})
    assert json.loads((tmp_path / "sub" / "a.json").read_text()) == {"x": 0.1, "q̈": None}
    write_text(tmp_path / "a.txt", "old")
    write_npz(tmp_path / "a.npz", {"x": np.arange(3)})
    np.testing.assert_array_equal(np.load(tmp_path / "a.npz", allow_pickle=False)["x"], np.arange(3))
    with pytest.raises(ValueError, match="pickle"):
        write_npz(tmp_path / "a.npz", {"x": np.array([{}])})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    with pytest.raises(UserError, match="cannot be written"):
        write_text(tmp_path / "a.txt" / "b.txt", "")
    for check, path, said in (
        (check_file, tmp_path, "is a folder"),
        (check_folder, tmp_path / "a.txt", "is a file"),
        (check_file, tmp_path / "a.txt" / "b" / "c", "cannot be written"),
        (check_folder, tmp_path / "a.txt" / "b", "cannot be written"),
    ):
        with pytest.raises(UserError, match=said):
            check(path)
    check_folder(tmp_path / "deep" / "down")
    check_file(tmp_path / "a.txt")
    with pytest.raises(UserError, match="cannot be written"), new_folder(tmp_path / "new") as folder:
        (folder / "missing" / "a").write_text("half")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "a.txt", "sub"]
    assert np.load(tmp_path / "a.npz")["x"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_harmless_variants_of_csv(write, end):
    expected = load_recordings(write()).recordings[0]
    text = csv(motion(np.arange(100) * 0.01))
    head, _, body = text.partition("\n")
    spaced = (
        "# made by hand\n\n"
        + " , ".join(f'"{name}"' for name in head.split(","))
        + "\n"
        + body.replace("\n", " \n\n", 5)
        + "  \n"
    )
    for variant in (
        spaced,
        "# " + text,
        text.replace(",", ";"),
        text.replace(",", "\t"),
        text.replace("\n", ",idle\n").replace(",idle\n", ",state\n", 1),
    ):
        data = b"\xef\xbb\xbf" + variant.replace("\n", end).encode()
        found = load_recordings(write(a=data)).recordings[0]
        np.testing.assert_array_equal(found.q, expected.q)
        np.testing.assert_array_equal(found.tau, expected.tau)
    assert found.ignored == ("state",)


def test_empty_cell_is_a_nan(write):
    lines = csv(motion(np.arange(20) * 0.01)).splitlines()
    lines[4] = ",".join(["0.03", "", *lines[4].split(",")[2:]])
    assert load_recordings(write(a="\n".join(lines))).recordings[0].dropped == 1


GOOD = csv(motion(np.arange(20) * 0.01))
ROWS = GOOD.splitlines()


def with_line(number, text):
    return "\n".join([*ROWS[: number - 1], text, *ROWS[number:]])


def with_cell(line, column, cell):
    cells = ROWS[line - 1].split(",")
    cells[column] = cell
    return with_line(line, ",".join(cells))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["a.csv", "empty"]),
        ("\n\n# nothing\n", ["empty"]),
        (ROWS[0], ["no rows", "at least 5"]),
        ("\n".join(ROWS[:4]), ["3 of 3 rows", "at least 5"]),
        ("\n".join(ROWS[1:]), ["line 1", "header"]),
        (GOOD.replace("q_joint2", "angle2", 1), ["line 1", "'q_joint2' is missing", "angle2", "required are t, q_joint1"]),
        (GOOD.replace("t,", "time,", 1), ["'t' is missing"]),
        (GOOD.replace("q_joint2", "q_joint1", 1), ["line 1", "'q_joint1' stands twice"]),
        (GOOD.replace("q_joint2", " ", 1), ["column 3 of 7 has no name"]),
        (GOOD.replace("tau_", "current_"), ["'tau_joint1' is missing"]),
        (with_cell(5, 2, "abc"), ["line 5", "'q_joint2'", "found 'abc'", "number or nan"]),
        (with_cell(5, 2, "1.0,2"), ["line 5", "8 cells", "7 columns"]),
        (with_line(21, "0.19"), ["line 21", "1 cell,"]),
        (with_cell(7, 3, "-inf"), ["line 7", "'q_joint3'", "infinite"]),
        ("# x\n\n" + with_cell(7, 3, "1e999"), ["line 9", "infinite"]),
        (with_cell(9, 0, "0.02"), ["line 9", "'t'", "0.02 s after 0.06 s", "must increase"]),
        (with_cell(9, 0, "0.06"), ["line 9", "0.06 s again"]),
        (b"\xff\xfe" + GOOD.encode("utf-16-le"), ["line 1", "0xff", "UTF-8"]),
        (GOOD.encode()[:300] + b"\x00" + GOOD.encode()[300:], ["line ", "found"]),
    ],
)
def test_what_is_wrong_with_a_csv_file(write, text, parts):
    message = refused(write(a=text))
    assert "a.csv" in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"format": "rrr_oc-recordings/2"}, ["format", "'rrr_oc-recordings/2'", "'rrr_oc-recordings/1'"]),
        ({"format": None}, ["'format' is missing"]),
        ({"robot": "rrrr"}, ["rrrr", "rrr, rrr_prototype"]),
        ({"robot": "x" * 5000}, ["cannot be read"]),
        ({"robot": 3}, ["robot: found 3", "text"]),
        ({"joints": ["joint1", "elbow"]}, ["'elbow'", "joint1, joint2, joint3"]),
        ({"joints": ["joint2", "joint1"]}, ["order of the chain"]),
        ({"joints": ["joint1", "joint1"]}, ["joints", "once"]),
        ({"joints": []}, ["joints: found []", "at least one"]),
        ({"torque": "Torque"}, ["torque: found 'Torque'", "'motor', 'load', 'current'"]),
        ({"torque": "current"}, ["actuators", "torque_constant", "joint1, joint2, joint3"]),
        ({"inertial": True}, ["inertial: found true", "'nominal', 'identify'"]),
        ({"gravity": [0, 0]}, ["gravity: found [0, 0]", "3 numbers"]),
        ({"gravity": [0, 0, "g"]}, ["gravity[2]: found 'g'"]),
        ({"tool": {"link": "hand", "position": [0, 0, 0]}}, ["no link 'hand'", "link3"]),
        ({"tool": {"link": "link3"}}, ["'position' is missing"]),
        ({"actuators": {"elbow": {}}}, ["unknown joint 'elbow'", "joint1, joint2, joint3"]),
        ({"actuators": {"joint1": {"torque_constant": 0}}}, ["torque_constant: found 0"]),
        ({"payloads": 5}, ["unknown key 'payloads'", "recordings"]),
        ({"recordings": []}, ["recordings: found []"]),
        ({"recordings": {"file": "a.csv"}}, ["a list"]),
        ({"recordings": [{"file": "a.csv"}, {"file": "./a.csv"}]}, ["recordings[1].file", "twice"]),
        ({"recordings": [{"file": "b.csv"}]}, ["b.csv", "No such file"]),
        ({"recordings": [{"file": "../a.csv"}]}, ["recordings[0].file: found '../a.csv'", "own folder"]),
        ({"recordings": [{"file": "/etc/passwd"}]}, ["own folder"]),
        ({"recordings": [{"file": "a\ud800.csv"}]}, ["text"]),
        ({"recordings": [{"payload": 1}]}, ["'file' is missing"]),
        ({"recordings": [{"file": "a.csv", "payload": -1}]}, ["recordings[0].payload: found -1", "from 0 to 10000"]),
        ({"recordings": [{"file": "a.csv", "payload": float("nan")}]}, ["payload: found nan"]),
        ({"recordings": [{"file": "a.csv", "payload": 10**400}]}, ["payload", "finite"]),
        ({"recordings": [{"file": "a.csv", "payload": 1e8}]}, ["payload: found 100000000", "from 0 to 10000"]),
        ({"gravity": [0, 0, -1e300]}, ["gravity[2]: found -1e+300", "up to 1e+09"]),
        ({"gravity": [0, 0, -1e5]}, ["gravity[2]: found -100000", "from -10000 to 10000"]),
        ({"recordings": [{"file": "a.csv", "payloads": 1}]}, ["unknown key 'payloads'", "payload"]),
    ],
)
def test_what_is_wrong_with_the_header(write, change, parts):
    message = refused(write({**ONE, **change}))
    for part in parts:
        assert part in message


PEA = {"stiffness_Nm_per_rad": 1, "equilibrium_rad": 0}
BPEA = {**PEA, "radius1_m": 0.02, "radius2_m": 0.02, "radius3_m": 0.02}


@pytest.mark.parametrize(
    ("springs", "parts"),
    [
        ({"pae": {}}, ["unknown key 'pae'", "pea, bpea"]),
        ({"pea": {"joint9": PEA}}, ["unknown joint 'joint9'"]),
        ({"pea": {"joint2": {**PEA, "active": "both"}}}, ["pea.joint2.active: found 'both'", "'below', 'above'"]),
        ({"pea": {"joint2": {**PEA, "stiffness_Nm_per_rad": -2}}}, ["found -2", "0 or more"]),
        ({"pea": {"joint2": {**PEA, "equilibrium_rad": 110}}}, ["found 110", "looks like degrees"]),
        ({"pea": {"joint2": {"equilibrium_rad": 1}}}, ["'stiffness_Nm_per_rad' is missing"]),
        ({"bpea": {**BPEA, "radius1_m": 15}}, ["radius1_m: found 15", "looks like millimetres"]),
        ({"bpea": {**BPEA, "radius2_m": 0}}, ["radius2_m: found 0", "or more"]),
        ({"bpea": {**BPEA, "joints": ["joint2"]}}, ["bpea.joints: found ['joint2']", "a list of 2"]),
        ({"bpea": {**BPEA, "joints": ["joint2", "joint2"]}}, ["bpea.joints", "two different"]),
        ({"bpea": {**BPEA, "joints": ["joint2", "x"]}}, ["bpea.joints: unknown joint 'x'", "joint1, joint2, joint3"]),
        ({"bpea": {**BPEA, "winding": [1, 2]}}, ["winding", "1 or -1"]),
    ],
)
def test_what_is_wrong_with_springs(write, springs, parts):
    message = refused(write({**ONE, "recordings": [{"file": "a.csv", "springs": springs}]}))
    for part in ("recordings[0].springs", *parts):
        assert part in message


def test_broken_json_and_missing_files(write, tmp_path):
    assert "line 1, column" in refused(write(json.dumps(ONE)[:-30]))
    assert "'robot' stands twice" in refused(write(json.dumps(ONE)[:-1] + ', "robot": "rrr"}'))
    assert "not usable JSON" in refused(write("[" * 100_000))
    assert "an object" in refused(write("[]"))
    (tmp_path / "recordings.json").write_bytes(b'{"format": "\xff"}')
    assert "UTF-8" in refused(tmp_path)
    assert "a folder with recordings.json is required" in refused(tmp_path / "nowhere")


def test_a_misspelt_column_is_no_silent_substitute(write):
    t = np.arange(50) * 0.01
    assert "'dqq_joint1'; is it 'dq_joint1'?" in refused(write(a={**motion(t), "dqq_joint1": 0 * t}))
    assert "'payloads'; is it 'payload'?" in refused(write(a={**motion(t), "payloads": 0 * t}))
    assert "'payload': found -1" in refused(write(a={**motion(t), "payload": 0 * t - 1}))
    others = {"temperature": 0 * t, "q_joint9": 0 * t, "q_ref_joint1": 0 * t, "status": 0 * t}
    assert load_recordings(write(a=motion(t) | others)).recordings[0].ignored == tuple(others)


def test_a_table_that_cannot_be_read_says_why(write):
    """A column without a number, decimal commas between commas, and rows that are counted in place of timed."""
    t = np.arange(100) * 0.01
    assert refused(write(a=motion(t) | {"tau_joint2": t * np.nan})).endswith("; no row has tau_joint2")
    header, rows = csv(motion(t)).split("\n", 1)
    assert refused(write(a=f"{header}\n{rows.replace('.', ',')}")).endswith("; decimal commas need ; or tabs between cells")
    notes = load_recordings(write(a=motion(t) | {"t": np.arange(100.0), "q_joint1": 2 * np.sin(9 * t)})).notes
    assert any(note.endswith("t goes up by 1 from row to row: is it the number of the row?") for note in notes)


def test_units(write):
    t = np.arange(300) * 0.006
    good = motion(t) | {"dq_joint1": 2.0 * np.cos(5 * t)}
    load_recordings(write(a=good))

    def scaled(columns, **factors):
        return {
            name: values * next((f for prefix, f in factors.items() if name.startswith(prefix)), 1)
            for name, values in columns.items()
        }

    assert "'q_joint1' spans -22.9 … 22.9" in refused(write(a=scaled(motion(t), q_=np.degrees(1))))
    assert "looks like degrees" in refused(write(a=scaled(motion(t), q_=np.degrees(1))))
    assert "looks like degrees, or the motor's angle before its gear" in refused(write(a=scaled(motion(t), q_=50)))
    for first, scale in ((2048, 4096), (0, 2**20)):
        counts = {n: np.round(first + x * scale / (2 * np.pi)) if n.startswith("q_") else x for n, x in motion(t).items()}
        assert "looks like an encoder's counts" in refused(write(a=counts))
    assert "'dq_joint1' is in degrees" in refused(write(a=scaled(good, dq_=np.degrees(1))))
    assert "revolutions per minute" in refused(write(a=scaled(good, dq_=60 / 2 / np.pi)))
    assert "wrong sign" in refused(write(a=scaled(good, dq_=-1)))
    assert "t is in milliseconds" in refused(write(a=scaled(good, t=1e3) | {f"tau_{j}": good[f"tau_{j}"] for j in JOINTS}))
    for factor, unit in ((1e4, "milli"), (1e6, "micro"), (1e9, "nano")):
        assert f"looks like {unit}seconds" in refused(write(a=motion(t) | {"t": t * factor}))
    assert "looks like milliseconds" in refused(write(a=motion(t) | {"t": t * 1e3}))
    for step in (1.0, 10.0):  # 1000 Hz and 100 Hz, slower than the limits of speed, over less than half a radian
        slow = {name: x / 2 if name.startswith("q_") else x for name, x in motion(step / 1e3 * np.arange(len(t))).items()}
        assert "looks like milliseconds" in refused(write(a=slow | {"t": slow["t"] * 1e3}))
    two = {**ONE, "recordings": [{"file": "a.csv"}, {"file": "b.csv"}]}
    still = motion(t) | {"t": t * 1e3} | {f"q_{j}": 0 * t for j in JOINTS}
    assert "b.csv looks like milliseconds" in refused(write(two, a=motion(t), b=still))
    assert "looks like mNm" in refused(write(a=scaled(motion(t), tau_=1e3)))
    speeds = good | {"ddq_joint1": np.degrees(-10.0 * np.sin(5 * t))}
    assert "'ddq_joint1' is in degrees" in refused(write(a=speeds))


def test_numbers_that_no_sensor_gives(write):
    columns = motion(np.arange(300) * 0.006)
    assert "q_joint1 reaches 1e+200" in refused(write(a=columns | {"q_joint1": 1e200 * np.sign(columns["q_joint1"])}))
    assert "tau_joint2 reaches 2e+12" in refused(write(a=columns | {"tau_joint2": 0 * columns["t"] - 2e12}))
    assert "found 1e+300; up to 10000 kg" in refused(write(a=columns | {"payload": 0 * columns["t"] + 1e300}))


def test_units_in_doubt_are_no_error(write):
    t = np.arange(300) * 0.006
    columns = motion(t)
    load_recordings(write(a=columns | {"q_joint1": columns["q_joint1"] + 25.0}))  # an encoder that counts turns
    load_recordings(write(a=columns | {"dq_joint1": np.random.default_rng(4).normal(size=300) * 60}))
    load_recordings(write(a=columns | {"dq_joint1": 1.5 * np.cos(5 * t + 0.1)}))
    load_recordings(write(a=columns | {"tau_joint1": np.where(t < 0.1, 1e5, 1.0)}))
    load_recordings(write(a={**columns, "t": t * 1e3, "q_joint1": 0 * t, "q_joint2": 1 + 1e-3 * t, "q_joint3": -1 + 1e-3 * t}))
    plausibility.check_time("", np.arange(5) * 9.0)


@pytest.mark.parametrize("name", ["xl330_pendulum", "staubli_tx40"])
def test_real_recordings_load(name):
    folder = real(name)
    for recording in load_recordings(folder).recordings:
        assert np.all(np.isfinite(recording.ddq))
        assert recording.short < 0.01 * len(recording.t)


BASE_JSON = json.dumps(EXAMPLE).encode()
BASE_CSV = csv(motion(np.round(np.arange(12) * 0.01, 3))).encode()
PIECES = [
    b",",
    b"\n",
    b"nan",
    b"inf",
    b"1e308",
    b"-1",
    b"\xff",
    b"\x00",
    b'"',
    b"{",
    b"]",
    b"#",
    b"1e-320",
    b"9" * 400,
    b"\r",
    b"null",
]
PIECES += [
    b"0",
    b"true",
    b";",
    b"\t",
    b"q_joint1",
    b"\\ud800",
    b"[]",
    b"-0",
    b"1e999",
    b"\xe2\x80\xa8",
    b"\x0c",
    b" ",
    b"payload",
    b"1_0",
]


@st.composite
def mutated(draw, base):
    data = bytearray(base)
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.integers(0, len(data)))
        stop = draw(st.integers(start, min(len(data), start + 20)))
        data[start:stop] = draw(st.sampled_from(PIECES) | st.binary(max_size=4))
    return bytes(data[: draw(st.integers(0, len(data)) | st.just(len(data)))])


@settings(max_examples=400, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(header=mutated(BASE_JSON) | st.just(BASE_JSON), table=mutated(BASE_CSV) | st.just(BASE_CSV))
@example(header=BASE_JSON, table=BASE_CSV.replace(b"0.01,", b"1e-320,"))
@example(header=BASE_JSON, table=BASE_CSV.replace(b"0.11,", b"1e308,"))
@example(header=BASE_JSON, table=BASE_CSV.replace(b"0.0,", b"-1e308,").replace(b"0.11,", b"1e308,"))
def test_any_bytes_end_in_success_or_one_error(write, tmp_path, header, table):
    write(EXAMPLE, sweep1=table, sweep2=table)
    (tmp_path / "recordings.json").write_bytes(header)
    try:
        found = load_recordings(tmp_path)
    except UserError:
        return
    assert all(np.all(np.isfinite(r.ddq)) for r in found.recordings)


def test_positions_given_within_a_turn_go_on(write):
    """A joint that turns over, wrapped at ±π; what jumps over a gap only is left as it is."""
    t = np.arange(300) / 100
    q = np.array([1.5 * t, np.where(t < 1.5, -2.0, 2.0) + 0.1 * np.sin(t), 0.1 * t])
    kept = (t < 1.4) | (t > 1.6)
    wrapped = np.array([(q[0] + np.pi) % (2 * np.pi) - np.pi, q[1], q[2]])
    table = np.vstack([t, wrapped, np.cos(t), np.sin(t), np.cos(2 * t)])[:, kept]
    text = "t,q_joint1,q_joint2,q_joint3,tau_joint1,tau_joint2,tau_joint3\n" + "\n".join(
        ",".join(map(repr, r)) for r in table.T.tolist()
    )
    loaded = load_recordings(write(ONE, a=text))
    np.testing.assert_allclose(loaded.recordings[0].q, q[:, kept], atol=1e-12)
    assert loaded.recordings[0].turned == ("q_joint1",)
    assert "jumped by a whole turn" in loaded.notes[0]


def moved_set(folder, motion, swap=False):
    """A recording of the arm in the contract's example whose joints move as `motion` (K times -> q, dq) says."""
    t = np.linspace(0, 4, 401)
    q, dq = motion(t)
    dq = dq[[1, 0, 2]] if swap else dq
    names = [f"{kind}_{joint}" for kind in ("q", "dq", "tau") for joint in JOINTS]
    rows = np.column_stack([t, *q, *dq, *(0.1 * np.cos(t + i) for i in range(3))])
    lines = [",".join(["t", *names]), *(",".join(map(repr, row)) for row in rows.tolist())]
    (folder / "a.csv").write_text("\n".join(lines))
    write_json(folder / "recordings.json", EXAMPLE | {"recordings": [{"file": "a.csv"}]})
    return load_recordings(folder).notes


def swinging(t):
    rates = np.array([[1.0], [1.7], [2.3]])
    return 0.4 * np.sin(rates * t), 0.4 * rates * np.cos(rates * t)


def test_speeds_of_another_joint_and_standstill_are_warned_of(tmp_path):
    assert not [note for note in moved_set(tmp_path, swinging) if "swapped" in note or "moves" in note]
    notes = moved_set(tmp_path, swinging, swap=True)
    assert "a.csv: dq_joint1 is the derivative of q_joint2, not of q_joint1; are columns swapped?" in notes
    assert len([note for note in notes if "swapped" in note]) == 2
    notes = moved_set(tmp_path, lambda t: np.zeros((2, 3, t.size)) + 0.3 * np.array([1, 0])[:, None, None])
    assert any("a.csv: no joint moves" in note for note in notes)


def test_columns_that_are_sums_are_read_as_joints(tmp_path):
    """An elbow's angle from the base, and the motors of a parallelogram: torques by the transposed, currents by their constants."""
    rng, t = np.random.default_rng(0), np.arange(200) / 100
    q = np.cumsum(rng.normal(0, 0.002, (3, 200)), axis=1)
    tau = rng.normal(size=(3, 200))
    from_motors, constant = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 1]]), np.array([2.0, 3.0, 5.0])
    columns = {f"q_joint{i + 1}": x for i, x in enumerate(np.linalg.solve(from_motors, q))}
    motors = np.linalg.solve(from_motors.T, tau)
    header = {
        "format": "rrr_oc-recordings/1", "robot": "rrr", "joints": ["joint1", "joint2", "joint3"],
        "coupling": {"q": from_motors.tolist(), "tau": from_motors.T.tolist()}, "recordings": [{"file": "a.csv"}],
        "actuators": {f"joint{i + 1}": {"torque_constant": k} for i, k in enumerate(constant)},
    }  # fmt: skip
    for kind, logged in (("tau", motors), ("current", motors / constant[:, None])):
        write_csv(tmp_path / "a.csv", {"t": t} | columns | {f"{kind}_joint{i + 1}": x for i, x in enumerate(logged)})
        (tmp_path / "recordings.json").write_text(json.dumps(header | {"torque": "motor" if kind == "tau" else "current"}))
        found = load_recordings(tmp_path)
        np.testing.assert_allclose(found.recordings[0].q, q, atol=1e-12)
        np.testing.assert_allclose(found.output_torque(found.recordings[0]), tau, atol=1e-12)
    (tmp_path / "recordings.json").write_text(json.dumps(header | {"coupling": {"q": [[1, 0], [0, 1]]}, "torque": "current"}))
    with pytest.raises(
        UserError, match=r"coupling\.q: 3 rows of 3 numbers are required, one for each joint, that can be inverted"
    ):
        load_recordings(tmp_path)
