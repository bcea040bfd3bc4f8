# pyright: reportAttributeAccessIssue=false
"""Sealed cases: recordings of random arms that passed a chain of measurement, and the truth about them.

    python -m validation.chains.make --out DIR --seed S --count N [--family NAME] [--kind clean|links|hidden|mixed] [--ideal]

A case is a folder with `recordings/` (and `recordings/test/`, of another motion) and `sealed/`: truth.json, the true arm as true.urdf,
and missing.npz with what is true at each row of each recording. In the kind "mixed", of eight cases of a family two have nothing
wrong, two a wrong link, three a hidden effect and one both.
"""

import argparse
import json
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from validation.chains.arms import Arm, described, made_wrong, random_arm
from validation.chains.chain import FINE, Chain, Rows, measure
from validation.chains.columns import explained, plain_columns
from validation.chains.effects import Effect, Law, Motion, drawn
from validation.chains.families import FAMILIES, RESERVED
from validation.chains.families.family import Family
from validation.chains.motions import points, sines
from validation.chains.plant import Exact, controlled, planned, torques

MIXED = ("clean", "hidden", "links", "hidden", "clean", "links", "hidden", "both")
CONSTANT = 0.1  # [A/Nm], current of a motor at the output of its gear


@dataclass(frozen=True)
class Case:
    """An arm as it was designed, as it is and as its file has it, what is hidden, and its chain of measurement."""

    name: str
    family: Family
    kind: str
    designed: Arm
    true: Arm
    listed: Arm
    off: dict[str, object] | None
    effects: tuple[Effect, ...]
    chain: Chain


def new_case(family_name: str, number: int, kind: str, seed: int, ideal: bool = False) -> Case:
    """A case, the same for the same numbers."""
    family = FAMILIES[family_name]
    rng = np.random.default_rng([seed, number, zlib.crc32(family_name.encode())])
    kind = MIXED[number % len(MIXED)] if kind == "mixed" else kind
    designed = random_arm(family.arm, rng)
    true, off = made_wrong(designed, rng) if kind in ("links", "both") else (designed, None)

    def allowed(law: Law) -> bool:
        possible = family.control is None or (law.acts != "twist" and not law.whole)
        return possible and law.inside == inside

    inside, listed = bool(rng.random() < 0.6), described(designed, rng)
    effects = (drawn(designed, allowed, rng),) if kind in ("hidden", "both") else ()
    chain = family.chain(rng)
    if ideal:
        chain = Chain(rate=chain.rate, bits=20, torque_noise=0.002)
        family = replace(family, control=family.control and replace(family.control, rate=FINE))
    return Case(f"{family_name}-{seed}-{number:03d}", family, kind, designed, true, listed, off, effects, chain)


def recorded(
    case: Case, index: int, test: bool, rng: np.random.Generator
) -> tuple[Rows, dict[str, np.ndarray], list[dict[str, Any]]]:
    """A recording, what is true at its rows, and the pushes in it."""
    family, arm = case.family, case.true
    plan = (points if family.points != test else sines)(arm.n, family.pace, rng)
    pushed, events = pushes(case, plan[0], rng)
    load = [e for e in case.effects if e.law.acts == "tool" and index % 2]
    for effect in load:
        arm = arm.with_mass(effect.parameters["share"] * case.designed.bodies[-1].mass)
    if family.control:
        exact = controlled(arm, case.listed, case.effects, plan, pushed, family.control)
    else:
        exact = planned(arm, case.effects, plan, pushed)
    exact = sensed(case.effects, exact)
    rows = measure(case.chain, exact.t, (exact.q, exact.v, exact.tau), case.designed.usual, rng)
    return rows, missing(case, exact, rows.at), events


def sensed(effects: Sequence[Effect], exact: Exact) -> Exact:
    """The signals as sensors with faults have them."""
    q, tau = exact.q.copy(), exact.tau.copy()
    for effect in effects:
        if effect.law.acts in ("sensor", "encoder"):
            for j, more in effect.of(Motion(exact.q, exact.v, np.sign(exact.v), exact.tau, exact.t)):
                (tau if effect.law.acts == "sensor" else q)[j] += more
    return exact._replace(q=q, tau=tau)


def pushes(case: Case, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """Torques from outside (n, F) [Nm], half sines, and when they were."""
    pushed, events = np.zeros((case.designed.n, t.size)), []
    for _ in range(rng.poisson(case.family.pushes) if case.family.pushes else 0):
        j, start, long = int(rng.integers(case.designed.n)), rng.uniform(0.5, t[-1] - 1), rng.uniform(0.1, 0.3)
        peak = case.designed.usual[j] * rng.uniform(0.3, 0.8) * rng.choice([-1, 1])
        inside = (t >= start) & (t < start + long)
        pushed[j, inside] += peak * np.sin(np.pi * (t[inside] - start) / long)
        events.append({"joint": case.designed.joints[j], "from": start, "to": start + long, "peak": peak})
    return pushed, events


def missing(case: Case, exact: Exact, at: np.ndarray) -> dict[str, np.ndarray]:
    """By name, (n, K) at the rows, the times of which are `t` (K,) [s].

    Motion q, v, a at the encoders; torque tau at the sensor, and load of the file [Nm]; of the torque what the file with plain friction
    and rotors does not need (`missing`), and in it the parts of hidden effects (`hidden`) and of a wrong link (`links`). What is missing
    holds usual errors of the file as well, but no pushes.
    """
    k = np.minimum(np.floor((at - exact.t[0]) * (len(exact.t) - 1) / np.ptp(exact.t) + 1e-6).astype(int), len(exact.t) - 1)
    q, v, a, tau, dry, pushed = (x[:, k] for x in exact[1:])
    true, designed, listed = (torques(arm.model, q, v, a) for arm in (case.true, case.designed, case.listed))
    drives = case.designed.rotor[:, None] * a + case.designed.viscous[:, None] * v + dry
    left = tau + pushed - drives
    return {
        "t": at, "q": q, "v": v, "a": a, "tau": tau, "load": listed, "missing": left - listed, "hidden": left - true, "links": true - designed
    }  # fmt: skip


def truth(case: Case, known: dict[str, dict[str, np.ndarray]], events: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """What is sealed of a case."""
    arm, chain = case.designed, case.chain
    links = [link_truth(arm, i, case.true.bodies[i].inertia, case.listed.bodies[i].inertia) for i in range(arm.n)]
    by_joint = [dict(zip(arm.joints, x.tolist(), strict=True)) for x in (arm.dry, arm.viscous, arm.rotor, arm.usual)]
    learned = [x for file, x in known.items() if not file.startswith("test/")]
    return {
        "case": case.name, "kind": case.kind, "joints": arm.joints, "links": dict(zip(arm.links, links, strict=True)),
        **dict(zip(("dry", "viscous", "rotor", "usual_torque"), by_joint, strict=True)),
        "sign_width": arm.kind.width, "torque_late_s": chain.torque_lag, "speed_late_s": chain.speed_lag, "chain": asdict(chain),
        "off": case.off and case.off | {"felt_as": felt_as(case, learned)},
        "effects": [effect.truth(arm) for effect in case.effects], "events": events,
    }  # fmt: skip


def link_truth(arm: Arm, i: int, true: pin.Inertia, listed: pin.Inertia) -> dict[str, Any]:
    """Mass [kg], first moment [kg m] and inertia about the joint's axis [kg m²] of a link, true and in the file."""

    def of(body: pin.Inertia) -> dict[str, Any]:
        about = body.inertia + body.mass * (body.lever @ body.lever * np.eye(3) - np.outer(body.lever, body.lever))
        axis = "xyz".index(arm.kind.axes[i])
        return {"mass": body.mass, "first_moment": (body.mass * body.lever).tolist(), "inertia_about_axis": about[axis, axis]}

    return {"true": of(true), "urdf": of(listed)}


def felt_as(case: Case, learned: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """By link, which share of the torque of a wrong link ten parameters of that link explain, beside plain friction and rotors."""
    x = {
        name: np.concatenate([one[name][..., :: max(1, one[name].shape[-1] // 300)] for one in learned], axis=-1)
        for name in learned[0]
    }
    model, n = case.listed.model, case.listed.n
    data = model.createData()
    each = [pin.computeJointTorqueRegressor(model, data, *row) for row in zip(x["q"].T, x["v"].T, x["a"].T, strict=True)]
    columns = np.array(each).transpose(1, 0, 2)  # (n, K, 10 n)
    beside = plain_columns(x["v"], x["a"])
    return {
        link: explained(x["links"], np.concatenate([beside, columns[:, :, 10 * i : 10 * i + 10]], axis=2), beside)
        for i, link in enumerate(case.listed.links[:n])
    }


def write(case: Case, out: Path, seed: int) -> None:
    """The folder of a case; the truth is written last."""
    folder = out / case.name
    shutil.rmtree(folder, ignore_errors=True)
    known, events = {}, {}
    for test in (False, True):
        place = folder / "recordings" / ("test" if test else "")
        place.mkdir(parents=True, exist_ok=True)
        files = []
        for i in range(2 if test else case.family.recordings):
            rng = np.random.default_rng([seed, zlib.crc32(case.name.encode()), i, test])
            rows, true, pushed = recorded(case, i, test, rng)
            files.append(f"r{i}.csv")
            label = f"test/{files[-1]}" if test else files[-1]
            known[label], events[label] = true, pushed
            write_rows(case, rows, place / files[-1])
        (place / "recordings.json").write_text(json.dumps(header(case, files, "../arm.urdf" if test else "arm.urdf"), indent=1))
    (folder / "recordings" / "arm.urdf").write_text(case.listed.urdf)
    sealed = folder / "sealed"
    sealed.mkdir()
    (sealed / "true.urdf").write_text(case.true.urdf)
    arrays = {f"{file}|{name}": x.astype(np.float32) for file, one in known.items() for name, x in one.items()}
    np.savez_compressed(sealed / "missing.npz", **arrays)
    (sealed / "truth.json").write_text(json.dumps(truth(case, known, events), indent=1))


def write_rows(case: Case, rows: Rows, path: Path) -> None:
    """A CSV file of the contract."""
    joints, current = case.designed.joints, case.family.current
    blocks = [("q", rows.q)] + ([("dq", rows.dq)] if rows.dq is not None else [])
    blocks.append(("current", CONSTANT * rows.tau) if current else ("tau", rows.tau))
    names = ["t"] + [f"{kind}_{joint}" for kind, _ in blocks for joint in joints]
    table = np.vstack([rows.t, *(x for _, x in blocks)]).T
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")


def header(case: Case, files: Sequence[str], robot: str) -> dict[str, Any]:
    """The content of recordings.json."""
    joints = case.designed.joints
    constants = {joint: {"torque_constant": 1 / CONSTANT} for joint in joints}
    return {
        "format": "rrr_oc-recordings/1", "robot": robot, "joints": joints, "torque": "current" if case.family.current else "motor",
        "recordings": [{"file": file} for file in files], **({"actuators": constants} if case.family.current else {}),
    }  # fmt: skip


def cases_of(folder: Path) -> list[Path]:
    """Folders of the cases, the families in turn."""
    cases = [file.parents[1].resolve() for file in folder.glob("*/sealed/truth.json")]
    return sorted(cases, key=lambda case: case.name.split("-")[::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=48, help="of cases, in turn of each family")
    parser.add_argument("--family", choices=sorted(FAMILIES), help="only this one")
    parser.add_argument("--kind", choices=["clean", "links", "hidden", "mixed"], default="mixed")
    parser.add_argument("--ideal", action="store_true", help="measured almost without a fault")
    options = parser.parse_args()
    names = [options.family] if options.family else [name for name in FAMILIES if name not in RESERVED]
    for i in range(options.count):
        case = new_case(names[i % len(names)], i // len(names), options.kind, options.seed, options.ideal)
        write(case, options.out, options.seed)
        print(case.name, case.kind, *(effect.name for effect in case.effects), flush=True)


if __name__ == "__main__":
    main()
