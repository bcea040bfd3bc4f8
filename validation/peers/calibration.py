"""How do peers calibrate dry friction, viscous friction and armature, where the truth is known?

    python validation/peers/calibration.py --out results/peers

The set with a known truth is that of `validation/calibration_coverage.py`: an independent plant of the three-joint arm, eight recordings
of 10 s with encoder counts, jitter and lost samples, of which two are held out. The links' inertial parameters are known.

- The project: least squares on inverse dynamics.
- `mujoco.sysid`: joint damping, friction loss and armature of the same URDF, from rollouts of half a second that begin at the recorded
  motion, driven by the recorded torque; its default optimiser. Its own sensors are position and speed.
- FIGAROH: its regressor with friction and armature for joint torques, base parameters by its QR decomposition. It estimates the links'
  parameters too, with which the armature is grouped, so that this is not compared.

Held out is the torque predicted from the recorded motion; of `mujoco.sysid` with the engine's inverse dynamics. Times are processor
times. A row is in OUT/calibration/<set> <tool>.json when it is whole.
"""

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import pinocchio as pin  # noqa: E402

from rrr_oc.calibration.calibrate import calibrate  # noqa: E402
from rrr_oc.calibration.prediction_error import error  # noqa: E402
from rrr_oc.recordings.recording import Recording, RecordingSet  # noqa: E402
from rrr_oc.robot.robot import load_robot  # noqa: E402
from rrr_oc.storage import write_json  # noqa: E402
from validation.calibration_coverage import WIDTH, record  # noqa: E402

# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
# (pin's and mujoco's wheels have no stubs, and peers are in environments of their own)

COUNT, HELD, SECONDS, SEED = 8, 2, 10.0, 5001
CHUNK, STEP = 0.5, 2e-3  # [s], of the rollouts
URDF = ROOT / "rrr_oc" / "urdf" / "rrr.urdf"
KINDS = ("coulomb", "viscous", "armature")
Predict = Callable[[Recording], np.ndarray]  # torque at all samples (n, K) [Nm]


def known() -> tuple[RecordingSet, np.ndarray]:
    """The recordings, and the truth (3, n): dry friction [Nm], viscous friction [Nm s/rad], armature [kg m²]."""
    rng, arm = np.random.default_rng(SEED), load_robot("rrr")
    model = pin.buildModelFromUrdf(str(URDF))
    truth = rng.uniform([[2], [2], [0.05]], [[6], [20], [0.4]], (3, arm.n))
    recordings = tuple(record(model, truth, SECONDS, f"{i}.csv", rng) for i in range(COUNT))
    return RecordingSet(arm, "rrr", "motor", "nominal", arm.tool, (None,) * arm.n, recordings, Path()), truth


def ours(train: RecordingSet) -> tuple[np.ndarray, Predict]:
    """The project's calibration: estimates (3, n), and its prediction."""
    model = calibrate(train)
    values = {(t.effect.name, t.effect.joints[0]): float(t.values[0]) for t in model.terms}
    names = ("dry_friction", "viscous_friction", "armature")
    return np.array([[values[name, j] for j in range(train.robot.n)] for name in names]), model.output_torque


def by_mujoco(train: RecordingSet) -> tuple[np.ndarray, Predict]:
    """`mujoco.sysid` on rollouts of half a second."""
    from mujoco import sysid

    joints, start = train.joints, {"frictionloss": 1.0, "damping": 5.0, "armature": 0.1}
    upper = {"frictionloss": 20.0, "damping": 60.0, "armature": 2.0}
    spec = _spec(joints)
    model = spec.compile()
    parameters = sysid.ParameterDict()
    for kind, value in start.items():
        for joint in joints:
            parameters.add(
                sysid.Parameter(
                    f"{joint}_{kind}", nominal=value, min_value=1e-4, max_value=upper[kind], modifier=_setter(joint, kind)
                )
            )
    states, controls, sensors = [], [], []
    for r in train.recordings:
        for begin in np.arange(r.t[0], r.t[-1] - CHUNK, CHUNK):
            t = np.arange(0, CHUNK, STEP)
            q, dq, tau = (np.array([np.interp(begin + t, r.t, row) for row in part]).T for part in (r.q, r.dq, r.tau))
            states.append(sysid.create_initial_state(model, q[0], dq[0], np.zeros(0)))
            controls.append(sysid.TimeSeries(t, tau))
            sensors.append(sysid.TimeSeries.from_names(t[1:], np.hstack([q, dq])[1:], model))
    names = [f"chunk{k}" for k in range(len(states))]
    sequences = sysid.ModelSequences("arm", spec, names, states, controls, sensors)
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    found, _ = sysid.optimize(initial_params=parameters, residual_fn=residual, optimizer="mujoco", verbose=False)
    values = np.array([[float(found[f"{joint}_{kind}"].value[0]) for joint in joints] for kind in start])
    return values, _inverse(joints, values)


def _setter(joint: str, kind: str) -> Callable[[Any, Any], None]:
    def change(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        setattr(spec.joint(joint), kind, [value, 0.0, 0.0] if kind == "damping" else value)

    return change


def _spec(joints: tuple[str, ...]) -> Any:
    """The arm's URDF as MuJoCo reads it, with motors, and sensors of position and speed."""
    spec = mujoco.MjSpec.from_file(str(URDF))
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    for joint in joints:
        spec.add_actuator(name=f"motor_{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for joint in joints:
            spec.add_sensor(name=f"{kind.name}_{joint}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
    return spec


def _inverse(joints: tuple[str, ...], values: np.ndarray) -> Predict:
    """The engine's inverse dynamics of the rigid arm, with the estimated friction and armature."""
    model = _spec(joints).compile()
    data = mujoco.MjData(model)

    def predict(r: Recording) -> np.ndarray:
        result = np.zeros_like(r.q)
        for k in range(len(r.t)):
            data.qpos[:], data.qvel[:], data.qacc[:] = r.q[:, k], r.dq[:, k], r.ddq[:, k]
            mujoco.mj_inverse(model, data)
            result[:, k] = data.qfrc_inverse
        return result + values[0][:, None] * np.tanh(r.dq / WIDTH) + values[1][:, None] * r.dq + values[2][:, None] * r.ddq

    return predict


def by_figaroh(train: RecordingSet) -> tuple[np.ndarray, Predict]:
    """FIGAROH's regressor and base parameters by least squares."""
    from figaroh.identification.identification_tools import get_standard_parameters
    from figaroh.identification.parameter import add_standard_additional_parameters
    from figaroh.tools.load_robot import load_robot as load
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import build_regressor_basic, build_regressor_reduced, get_index_eliminate

    n = len(train.joints)
    robot = load(str(URDF), package_dirs=str(URDF.parent), loader="figaroh")
    zeros = [0.0] * n
    config = {
        "is_joint_torques": True, "is_external_wrench": False, "force_torque": None, "has_friction": True,
        "has_actuator_inertia": True, "has_joint_offset": False, "act_idxv": list(range(n)), "fv": zeros, "fs": zeros, "Ia": zeros,
    }  # fmt: skip

    def regressor(recordings: Sequence[Recording]) -> np.ndarray:
        q, dq, ddq = (np.concatenate([getattr(r, key) for r in recordings], axis=1).T for key in ("q", "dq", "ddq"))
        return build_regressor_basic(robot, q, dq, ddq, config)

    standard = get_standard_parameters(robot.model, config)
    standard |= add_standard_additional_parameters(robot.model, config)
    whole = regressor(train.recordings)
    gone, kept = get_index_eliminate(whole, standard, 1e-3)
    decomposer = QRDecomposer()
    tau = np.concatenate([r.tau for r in train.recordings], axis=1).reshape(-1)  # all samples of a joint, then of the next
    _, _, names, found = decomposer.double_decomposition(tau, build_regressor_reduced(whole, gone), kept)
    columns = decomposer.get_base_indices()
    by_name = {name.split(" ")[0]: value for name, value in zip(names, found, strict=True)}
    values = np.array([[by_name.get(f"{kind}_{joint}", np.nan) for joint in train.joints] for kind in ("fs", "fv")])

    def predict(r: Recording) -> np.ndarray:
        return (build_regressor_reduced(regressor([r]), gone)[:, columns] @ found).reshape(n, -1)

    return np.vstack([values, np.full((1, n), np.nan)]), predict


TOOLS: dict[str, Callable[[RecordingSet], tuple[np.ndarray, Predict]]] = {
    "rrr_oc": ours,
    "mujoco.sysid": by_mujoco,
    "FIGAROH": by_figaroh,
}


def row(tool: Callable[[RecordingSet], tuple[np.ndarray, Predict]], whole: RecordingSet, truth: np.ndarray) -> dict[str, Any]:
    """Largest relative error over the joints of each kind of parameter, NRMSE on what is held out, processor time [s]."""
    train = replace(whole, recordings=whole.recordings[:-HELD])
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values, predict = tool(train)
    spent = time.process_time() - began
    errors = [error(r.t, r.tau, predict(r), r.segments)["nrmse"] for r in whole.recordings[-HELD:]]
    off = np.abs(values / truth - 1).max(axis=1)
    found = {kind: None if np.isnan(x) else float(x) for kind, x in zip(KINDS, off, strict=True)}
    return {"set": "known truth"} | found | {"nrmse": float(np.mean(errors)), "seconds": spent}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    options = parser.parse_args()
    whole, truth = known()
    for name, tool in TOOLS.items():
        path = options.out.resolve() / "calibration" / f"known truth {name}.json"
        if path.exists():
            continue
        with tempfile.TemporaryDirectory() as folder:
            here = Path.cwd()
            os.chdir(folder)  # a tool may leave files where it is run
            try:
                found = row(tool, whole, truth)
            except ModuleNotFoundError as missing:
                print(f"{name}: left out, since it is not installed: {missing}", flush=True)
                continue
            finally:
                os.chdir(here)
        write_json(path, {"tool": name} | found)
        print(f"{name}: {found}", flush=True)


if __name__ == "__main__":
    main()
