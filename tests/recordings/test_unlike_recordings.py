# pyright: reportAttributeAccessIssue=false
"""What is wrong in one recording, or in a piece of it, units of angles and payloads, and limits in noise; on an arm of MuJoCo's dynamics."""

from functools import cache

import mujoco
import numpy as np
import pytest
from swung import written

from rrr_oc.calibration.prediction_error import error
from rrr_oc.recordings.consistency import check_consistency
from rrr_oc.recordings.faults import cut_off, flat_top
from rrr_oc.recordings.reader import load_recordings

JOINTS = ("j1", "j2", "j3")
AXES, OFFSETS = ("0 0 1", "0 1 0", "0 1 0"), ("0 0 .1", "0 .02 .15", "0 0 .35")
MASSES, CENTRES = (2.0, 3.2, 1.6), (".01 0 .08", ".01 .03 .16", ".04 -.02 .13")
INERTIAS, DRIVES = (".006 .006 .004", ".03 .03 .006", ".012 .011 .003"), ((0.5, 0.3, 0.05), (0.8, 0.4, 0.09), (0.4, 0.2, 0.03))
TIP = "0 0 .25"
RATE, SECONDS = 100, 8.0


@cache
def engine(payload: float) -> mujoco.MjModel:
    """The arm with a payload [kg]."""
    text = "<mujoco><compiler angle='radian'/><worldbody>"
    for axis, offset, mass, centre, inertia in zip(AXES, OFFSETS, MASSES, CENTRES, INERTIAS, strict=True):
        text += f"<body pos='{offset}'><inertial pos='{centre}' mass='{mass}' diaginertia='{inertia}'/><joint axis='{axis}'/>"
    held = f"<body pos='{TIP}'><inertial pos='0 0 0' mass='{payload}' diaginertia='1e-7 1e-7 1e-7'/></body>" * (payload > 0)
    return mujoco.MjModel.from_xml_string(f"{text}{held}{'</body>' * 3}</worldbody></mujoco>")


def urdf(effort: float) -> str:
    """The same arm, with a limit of torque [Nm]."""
    text = "<robot name='arm'><link name='l0'/>"
    for k, (axis, offset, mass, centre, inertia) in enumerate(zip(AXES, OFFSETS, MASSES, CENTRES, INERTIAS, strict=True), 1):
        moments = " ".join(f"{name}='{x}'" for name, x in zip(("ixx", "iyy", "izz"), inertia.split(), strict=True))
        text += (
            f"<link name='l{k}'><inertial><origin xyz='{centre}'/><mass value='{mass}'/><inertia {moments} ixy='0' ixz='0' iyz='0'/>"
            f"</inertial></link>"
            f"<joint name='j{k}' type='revolute'><parent link='l{k - 1}'/><child link='l{k}'/><origin xyz='{offset}'/><axis xyz='{axis}'/>"
            f"<limit lower='-100' upper='100' effort='{effort}' velocity='10'/></joint>"
        )
    tip = f"<joint name='tip' type='fixed'><parent link='l3'/><child link='tool'/><origin xyz='{TIP}'/></joint>"
    return f"{text}<link name='tool'/>{tip}</robot>"


@cache
def recorded(seed: int, payload: float = 0.0) -> dict[str, np.ndarray]:
    """Columns of a motion, with torques of MuJoCo's inverse dynamics, friction, rotors and noise."""
    rng, t = np.random.default_rng(seed), np.arange(0, SECONDS, 1 / RATE)
    w = 2 * np.pi * 0.13 * np.arange(1, 6)[:, None, None]
    phase, size = rng.uniform(0, 2 * np.pi, (5, 3, 1)), rng.uniform(0.3, 1, (5, 3, 1)) / w
    x = w * t + phase
    q, dq, ddq = ((size * part).sum(axis=0) for part in (np.sin(x), w * np.cos(x), -(w**2) * np.sin(x)))
    scale = (1.2 / np.abs(q).max(axis=1))[:, None]
    q, dq, ddq = scale * q, scale * dq, scale * ddq
    model, tau = engine(payload), np.zeros_like(q)
    data = mujoco.MjData(model)
    for k in range(t.size):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[:, k], dq[:, k], ddq[:, k]
        mujoco.mj_inverse(model, data)
        tau[:, k] = data.qfrc_inverse
    dry, viscous, rotor = np.array(DRIVES).T[:, :, None]
    tau += dry * np.tanh(dq / 0.01) + viscous * dq + rotor * ddq
    tau += 0.01 * tau.std(axis=1, keepdims=True) * rng.standard_normal(tau.shape)
    return {"t": t} | {f"q_{j}": q[i] for i, j in enumerate(JOINTS)} | {f"tau_{j}": tau[i] for i, j in enumerate(JOINTS)}


def loaded(folder, files, header=None, effort=100.0):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(effort))
    return load_recordings(written(folder, {"robot": "arm.urdf", "joints": list(JOINTS)} | (header or {}), **files))


def doubts(*args, **more):
    return check_consistency(loaded(*args, **more)).doubts


def times(of, factor, *kinds):
    return of | {name: factor * x for name, x in of.items() if name.startswith(kinds)}


def stopped():
    """Brakes hold the arm from 5.8 s on, and its drives are off."""
    of, k = recorded(1), round(5.8 * RATE)
    noise = 0.01 * np.random.default_rng(0).standard_normal(of["t"].size)
    return {
        name: x if name == "t" else np.where(np.arange(x.size) < k, x, x[k] if name.startswith("q_") else noise)
        for name, x in of.items()
    }


def changed(at: float, other: dict[str, np.ndarray], of: dict[str, np.ndarray]):
    return {name: np.where(of["t"] > at, other[name], x) for name, x in of.items()}


PIECES = {
    "stopped": (stopped, "from 5.8 to 7.99 s"),
    "payload put on": (lambda: changed(5.0, recorded(1, 2.0), recorded(1)), "from 5 to 7.99 s"),
    "pushed": (
        lambda: recorded(1) | {"tau_j2": recorded(1)["tau_j2"] + 15.0 * (np.abs(recorded(1)["t"] - 3) < 0.7)},
        "from 2.31 to 3.69 s",
    ),
}


@pytest.mark.parametrize("name", PIECES)
def test_a_recording_that_is_another_arms_in_a_piece_of_it_is_named_with_the_piece(tmp_path, name):
    make, when = PIECES[name]
    (doubt,) = doubts(tmp_path, {"a": recorded(0), "b": make(), "c": recorded(2)})
    assert doubt.kind == "recording"
    assert doubt.said.startswith("b.csv: the torque of j")
    begin, end = (float(x) for x in doubt.said.partition(" from ")[2].partition(" s is")[0].split(" to "))
    right = [float(x) for x in when.removeprefix("from ").removesuffix(" s").split(" to ")]
    assert [begin, end] == pytest.approx(right, abs=0.06)  # two of the samples that are compared


@pytest.mark.parametrize("factor", [1000.0, 0.01])
def test_torques_of_one_recording_in_another_unit_are_named_and_nothing_is_said_of_the_others(tmp_path, factor):
    (doubt,) = doubts(tmp_path, {"a": recorded(0), "b": times(recorded(1), factor, "tau_"), "c": recorded(2)}, effort=0.0)
    assert doubt.kind == "unit"
    assert doubt.said.startswith("b.csv: all torques are ")


def test_torques_of_a_smaller_multiple_for_each_joint_may_be_another_arms(tmp_path):
    """As of currents whose constants nobody knows; each joint is named, with the rival beside it."""
    factors = {"tau_j1": 0.33, "tau_j2": 0.3, "tau_j3": 0.2}
    every = [recorded(k) | {name: factor * recorded(k)[name] for name, factor in factors.items()} for k in (0, 1)]
    found = doubts(tmp_path, dict(zip("ab", every, strict=True)))
    assert {doubt.said.partition(" times")[0] for doubt in found} == {f"{name} is {factor}" for name, factor in factors.items()}
    assert any("as of another arm" in rival for rival in found[0].rivals)


def test_recordings_that_all_lack_the_same_physics_are_not_told_apart(tmp_path):
    """A spring that is not listed, and one payload more in each: no recording is another arm's."""
    files = {name: recorded(k) | {"tau_j3": recorded(k)["tau_j3"] + 6 * recorded(k)["q_j3"]} for k, name in enumerate("abc")}
    assert doubts(tmp_path / "spring", files) == ()
    assert doubts(tmp_path / "right", {name: recorded(k) for k, name in enumerate("abc")}) == ()


PAYLOADS = {
    "lb": ([0, 2.2046, 4.4092], "the listed payloads of up to 4.4092 kg fit when they are multiplied by 0.4536, as if in lb: "),
    "g": ([0, 0.001e6, 0.002e6], "the listed payloads of up to 2000 kg fit when they are multiplied by 0.001, as if in g: "),
    "swapped": ([2, 1, 0], "the listed payloads of a.csv and c.csv (2 and 0 kg) fit when they are swapped: "),
}


@pytest.mark.parametrize("name", PAYLOADS)
def test_payloads_that_are_listed_wrongly_are_named(tmp_path, name):
    listed, said = PAYLOADS[name]
    header = {"recordings": [{"file": f"{file}.csv", "payload": x} for file, x in zip("abc", listed, strict=True)]}
    (doubt,) = doubts(tmp_path, {file: recorded(k, float(k)) for k, file in enumerate("abc")}, header)
    assert (doubt.kind, doubt.said.startswith(said)) == ("payload", True), doubt.said


@pytest.mark.parametrize(
    ("factor", "columns", "said"),
    [
        (1 / (2 * np.pi), ("q_",), "positions fit when they are multiplied by 6.28, as angles in turns: "),
        (5.0, ("q_j3",), "q_j3 fits when it is multiplied by 0.2, as angles before a gear of 1:5: "),
        (180 / np.pi, ("q_j2",), "q_j2 fits when it is multiplied by 0.0175, as angles in degrees: "),
    ],
)
def test_angles_in_another_unit_are_named(tmp_path, factor, columns, said):
    (doubt, *_) = doubts(tmp_path, {"a": times(recorded(0), factor, *columns), "b": times(recorded(1), factor, *columns)})
    assert doubt.said.startswith(said)


LIMIT = 10.0


def noisy_limit(seed):
    noise = 0.08 * np.random.default_rng(seed).standard_normal(round(SECONDS * RATE))
    return recorded(seed) | {"tau_j2": np.clip(recorded(seed)["tau_j2"], -LIMIT, LIMIT) + noise}


def test_a_limit_in_noise_is_named_where_the_file_lacks_it_and_left_out_where_it_has_it(tmp_path):
    files = {"a": noisy_limit(0), "b": noisy_limit(1)}
    (doubt,) = doubts(tmp_path / "lacks", files)
    assert (doubt.kind, doubt.columns) == ("limit", ("tau_j2",))
    assert doubt.said.startswith("tau_j2 stays at 9.99 Nm, where the arm needs ")
    found = loaded(tmp_path / "has", files, effort=LIMIT)
    assert check_consistency(found).doubts == ()
    true = np.abs(recorded(0)["tau_j2"]) > LIMIT
    counted = ~found.clipped(found.recordings[0])[1]
    assert np.mean(counted == ~true) > 0.97  # rows whose noise reaches to the limit are beside it
    assert any("tau_j2 is cut off at 9.9" in note for note in found.notes)


def test_steady_friction_in_noise_is_no_limit(tmp_path):
    """At constant speeds the torque of a joint without gravity is as flat as at a limit, and the arm needs no more."""
    t = np.arange(0, SECONDS, 1 / RATE)
    files = {}
    for k, name in enumerate("ab"):
        of, swing = recorded(k).copy(), np.abs((t / 2 + 0.3 * k) % 2 - 1)
        speed = np.sign((t / 2 + 0.3 * k) % 2 - 1) / 2
        still = {f"q_{j}": np.full_like(t, 0.4) for j in ("j2", "j3")} | {
            f"tau_{j}": np.full_like(t, 3.0) for j in ("j2", "j3")
        }
        tau = 1.5 * speed / 0.5 + 0.01 * np.random.default_rng(k).standard_normal(t.size)
        files[name] = of | still | {"q_j1": swing, "tau_j1": tau}
    assert flat_top(files["a"]["tau_j1"])[0].any()
    assert not [doubt for doubt in doubts(tmp_path, files) if doubt.kind == "limit"]


def test_a_torque_that_goes_beyond_a_limit_or_stays_below_it_is_not_cut_off():
    tau = recorded(0)["tau_j2"]
    assert not cut_off(tau, 0.8 * float(np.max(np.abs(tau)))).any()
    assert not cut_off(tau, 1.1 * float(np.max(np.abs(tau)))).any()


def test_what_is_cut_off_does_not_count_in_an_error():
    t = np.arange(0, 4, 0.01)
    true = np.array([np.sin(3 * t), np.cos(2 * t)])
    recorded_ = np.maximum(true, [[-0.5], [-2.0]])
    found = error(t, recorded_, true, (slice(0, t.size),), counted=recorded_ > -0.5)
    assert found["nrmse"].max() < 0.05 < error(t, recorded_, true, (slice(0, t.size),))["nrmse"][0]
    none = error(t, recorded_, true, (slice(0, t.size),), counted=np.array([[False], [True]]) & (t > 0))
    assert np.isnan(none["nrmse"][0])
    assert none["nrmse"][1] < 1e-12


def test_columns_that_are_copies_are_told(tmp_path):
    found = loaded(tmp_path, {"a": recorded(0) | {"q_j3": recorded(0)["q_j2"]}})
    assert "a.csv: q_j3 holds the same numbers as q_j2 in every row; was one of them recorded?" in found.notes
