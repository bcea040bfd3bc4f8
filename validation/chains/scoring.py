# pyright: reportAttributeAccessIssue=false
"""What a diagnosis says of a case, by degree: that something is missing, where, on what it depends, which law; and what it says wrongly.

It reads the content of `diagnosis.json` and the sealed truth, and knows nothing else of the tool. What the tool calls equal to an entry
(`rivals`) counts as said. Of fields that a diagnosis does not have, nothing is counted.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from validation.chains.columns import explained, flexible, law_columns, plain_columns

FELT = 0.02  # share of a joint's torque from which something is missing there
HALF, EQUAL, SAME = 0.5, 0.8, 0.9  # shares of what is missing that variables must explain; a law and a link to count as equal
SURE = 3.0  # usual errors of a file that a link is off by, to be off even where none was made wrong
SAMPLES = 3000  # of a case, that are looked at
USUAL = (
    0.03,
    0.01,
    0.01,
    0.01,
    0.05,
    0.05,
    0.05,
)  # errors of a file: share of a mass, centre [m], shares of the moments about it
FEW, ALIKE = 300, 0.95  # samples at which links are compared, and share of a torque that such errors must explain
NEAR_ORDER = 1.0  # cycles per turn, to be the same ripple
BODIES = ("payload_mass", "payload_com", "link_inertial")
VARIABLES = {  # of laws, at their joint
    "stribeck": ("dq",), "quadratic_drag": ("dq",), "viscous_asymmetry": ("dq",), "coulomb_asymmetry": ("sign(dq)",),
    "torque_ripple": ("q",), "cable_harness": ("q",), "parallel_spring": ("q",), "encoder_offset": ("q",),
    "position_dependent_friction": ("q", "sign(dq)"), "presliding_hysteresis": ("q", "sign(dq)"), "torque_gain": ("load_torque",),
    "load_dependent_friction": ("load_torque", "sign(dq)"), "friction_drift": ("time", "sign(dq)"), "coupled_friction": ("dq",),
    "two_sided_biarticular_spring": ("q",), "biarticular_spring": ("q",), "gravity_tilt": ("q",), "payload_mass": ("q",),
}  # fmt: skip
Entry = Mapping[str, Any]


class Sealed:
    """The truth of a case, with what is missing at its rows: `x` by name, (n, K), all recordings one after the other; `x["t"]` (K,)."""

    def __init__(self, truth: Mapping[str, Any], x: dict[str, np.ndarray], model: pin.Model):
        self.truth, self.x, self.model = truth, x, model
        self.joints, self.links = list(truth["joints"]), list(truth["links"])
        self.beside = plain_columns(x["v"], x["a"])
        every = range(len(self.joints))
        self.felt = [j for j in every if self.share_left(x["hidden"] + x["links"], j) > FELT]
        self.hidden = [j for j in every if self.share_left(x["hidden"], j) > FELT]

    @classmethod
    def read(cls, folder: Path, truth: Mapping[str, Any]) -> "Sealed":
        """From the folder `sealed` of a case."""
        parts: dict[str, list[np.ndarray]] = {}
        with np.load(folder / "missing.npz") as file:
            for key, rows in file.items():
                name, what = key.split("|")
                if not name.startswith("test/"):
                    parts.setdefault(what, []).append(rows)
        every = max(1, sum(rows.shape[-1] for rows in parts["q"]) // SAMPLES)
        x = {what: np.concatenate(rows, axis=-1)[..., ::every].astype(float) for what, rows in parts.items()}
        return cls(truth, x, pin.buildModelFromUrdf(str(folder / "true.urdf")))

    def share_left(self, torque: np.ndarray, j: int) -> float:
        """What plain friction and rotor leave of a torque (n, K) at a joint, as a share of the joint's torque."""
        columns, y = self.beside[j, :, 3 * j : 3 * j + 3], torque[j]
        return float(np.std(y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) / np.std(self.x["tau"][j]))

    def depends(self, j: int, variables: Sequence[str]) -> bool:
        """Whether a flexible function of these variables explains half of what varies in the hidden torque of a joint."""
        own = np.insert(self.beside[j : j + 1, :, 3 * j : 3 * j + 3], 0, 1, axis=2)
        free = flexible(list(variables), self.x, self.joints, j)[None]
        return explained(self.x["hidden"][j : j + 1], np.concatenate([own, free], axis=2), own) >= HALF

    def equal(self, name: str, at: Sequence[int]) -> bool:
        """Whether a law at joints explains all but a little of what is missing, or of what is hidden in it."""
        shapes = [np.concatenate([self.beside, columns], axis=2) for columns in law_columns(name, list(at), self.x)]
        targets = (self.x["hidden"], self.x["hidden"] + self.x["links"])
        return any(explained(target, columns, self.beside) >= EQUAL for columns in shapes for target in targets)

    def right(self, entry: Entry) -> bool:
        """Whether an effect is there, or equal to what is there."""
        name, at = entry["effect"], self.at(entry)
        if name == "time_delay":
            return abs(self.truth["torque_late_s"]) >= 0.001
        for effect in self.truth["effects"]:
            if is_part_of(entry, effect) and at == self.at(effect):
                return True
            if effect["effect"] == name and (set(at) & set(self.at(effect)) or not (at and self.at(effect))):
                return True
        if name in BODIES:
            return bool(self.truth["off"]) and self.truth["off"]["felt_as"][self.links[at[0] if at else -1]] >= SAME
        return bool(at and self.felt) and self.equal(name, at)

    def there(self, entry: Entry) -> bool:
        """Whether an effect is right, or the ripple that the chain of measurement adds to the torques of all joints."""
        chain = self.truth["chain"]
        if self.right(entry):
            return True
        if entry["effect"] != "torque_ripple" or not chain["ripple"]:
            return False
        return abs(entry["parameters"]["order"]["value"] - chain["ripple_cycles"]) < NEAR_ORDER

    def at(self, entry: Entry) -> list[int]:
        """Numbers of an entry's joints; none for the arm as a whole."""
        joint = entry["joint"]
        names = [joint] if isinstance(joint, str) else joint or []
        return [self.joints.index(name) for name in names if name in self.joints]

    def usual_errors(self) -> float:
        """How many usual errors of a file feel as the wrong link, all together: the length of the shortest such vector of errors.

        Where that is few, torques do not tell the link from those of a file as good as usual.
        """
        some = slice(None, None, max(1, self.x["t"].size // FEW))
        q, v, a, y = (self.x[key][:, some] for key in ("q", "v", "a", "links"))
        data, beside = self.model.createData(), plain_columns(v, a)
        each = [pin.computeJointTorqueRegressor(self.model, data, *row) for row in zip(q.T, v.T, a.T, strict=True)]
        changes = np.zeros((10 * len(q), len(USUAL) * len(q)))
        for i, body in enumerate(list(self.model.inertias)[1:]):
            changes[10 * i : 10 * i + 10, len(USUAL) * i : len(USUAL) * (i + 1)] = usual_changes(body)
        columns = np.concatenate([np.array(each).transpose(1, 0, 2) @ changes, y[:, :, None]], axis=2)  # (n, K, 7 n + 1)
        plain = [beside[j, :, 3 * j : 3 * j + 3] for j in range(len(q))]
        left = [
            (own - b @ np.linalg.lstsq(b, own, rcond=None)[0]) / np.std(tau)
            for own, b, tau in zip(columns, plain, self.x["tau"], strict=True)
        ]
        whole = np.concatenate(left)
        u, s, vt = np.linalg.svd(whole[:, :-1], full_matrices=False)
        along = u.T @ whole[:, -1]
        explained_by = np.cumsum(along**2) / max(float(whole[:, -1] @ whole[:, -1]), 1e-300)
        count = int(np.searchsorted(explained_by, ALIKE)) + 1
        return float(np.linalg.norm((along[:count] / s[:count]) @ vt[:count]))

    def off(self, link: str) -> bool:
        """Whether a link is not as its file has it, by more than usual, or feels as one that is not."""
        true, urdf = (self.truth["links"][link][which] for which in ("true", "urdf"))
        centres = [np.array(body["first_moment"]) / body["mass"] for body in (true, urdf)]
        far = abs(np.log(true["mass"] / urdf["mass"])) > SURE * 0.03 or np.abs(centres[0] - centres[1]).max() > SURE * 0.01
        return bool(far) or (bool(self.truth["off"]) and self.truth["off"]["felt_as"][link] >= SAME)


def usual_changes(body: pin.Inertia) -> np.ndarray:
    """Change of a body's ten dynamic parameters by each of the `USUAL` errors, (10, 7)."""
    now, result = body.toDynamicParameters(), [USUAL[0] * body.toDynamicParameters()]
    for k in range(3):
        result.append(
            pin.Inertia(body.mass, body.lever + USUAL[1 + k] * np.eye(3)[k], body.inertia).toDynamicParameters() - now
        )
    for k in range(3):
        more = USUAL[4 + k] * body.inertia[k, k] * np.diag(np.eye(3)[k])
        result.append(pin.Inertia(body.mass, body.lever, body.inertia + more).toDynamicParameters() - now)
    return np.array(result).T


def is_part_of(entry: Entry, effect: Entry) -> bool:
    """Whether a ripple is one of the harmonics that the torque of a magnetic detent is made of."""
    if (entry["effect"], effect["effect"]) != ("torque_ripple", "magnetic_detent"):
        return False
    harmonic = entry["parameters"]["order"]["value"] * effect["parameters"]["pitch"] / (2 * np.pi)
    return abs(harmonic - round(harmonic)) < 0.1 and round(harmonic) >= 1


def score(found: Mapping[str, Any], sealed: Sealed) -> Counter[str]:
    """Counts of a case by name; "a/b" is counted where "a" is possible and b holds."""
    result = Counter[str]({"cases": 1})
    truth, effects = sealed.truth, found["effects"]
    said = [e for e in effects if e["effect"] != "time_delay"]
    classes = [m for u in found.get("undecided", ()) for m in u["members"]]
    for name, entries in (("claims", effects), ("small claims", found.get("small", ()))):
        wrong = [e["effect"] for e in entries if not any(sealed.there(x) for x in (e, *e.get("rivals", ())))]
        result.update({name: len(entries), f"{name}/false": len(wrong)})
        result.update(f"false: {effect}" for effect in wrong if name == "claims")
    torques = found["unexplained"]
    result.update({"torques": len(torques), "torques/false": sum(not set(sealed.at(u)) & set(sealed.felt) for u in torques)})
    if truth["kind"] == "clean":
        links = [f for f in found["link_findings"] if not sealed.off(f["link"])]
        # A delay, a ripple of the chain or a link that happens to be off may be told
        sure = found["verdict"] == "nothing_missing" or bool(effects or found["link_findings"])
        result.update({"clean": 1, "clean/right": int(sure and not (result["claims/false"] or torques or classes or links))})
    told = found["link_findings"]
    result.update({"links told": len(told), "links told/right": sum(link_right(f, sealed) for f in told)})
    if truth["off"]:
        here = any(
            f["link"] == truth["off"]["link"] or truth["off"]["joint"] in directions(f) or link_right(f, sealed) for f in told
        )
        as_effect = any(e["effect"] in BODIES and sealed.right(e) for e in [*effects, *classes])
        result.update({"links off": 1, "links off/told": int(here), "links off/told as an effect": int(as_effect and not here)})
        beyond = int(sealed.usual_errors() > SURE)
        result.update({"links off beyond usual": beyond, "links off beyond usual/told": beyond * int(here or as_effect)})
    if truth["effects"]:
        result.update(degrees([*said, *torques], classes, sealed))
    result.update(events(found, truth))
    return result


def link_right(entry: Entry, sealed: Sealed) -> bool:
    """Whether a link that is told is off, or the link of one of its directions is."""
    joints = [sealed.links[sealed.joints.index(j)] for j in directions(entry) if j in sealed.joints]
    return any(sealed.off(link) for link in (entry["link"], *joints) if link in sealed.links)


def directions(entry: Entry) -> list[str]:
    """Joints about which a link is said to be off."""
    return [d["joint"] for d in entry.get("directions", ())]


def degrees(entries: Sequence[Entry], classes: Sequence[Entry], sealed: Sealed) -> Counter[str]:
    """What is said of a hidden effect: where, on what it depends, which law; or nothing."""
    names = [x for e in entries for x in (e, *e.get("rivals", ()))] + list(classes)
    others = {*BODIES, "time_delay"} - {e["effect"] for e in sealed.truth["effects"]}
    law = any(sealed.right(x) for x in names if x.get("effect", "time_delay") not in others)
    where = law or any(set(sealed.at(e)) & set(sealed.hidden) for e in entries)
    what = law or any(sealed.depends(j, variables(e, sealed)) for e in entries for j in sealed.at(e) if j in sealed.hidden)
    inside = sealed.truth["effects"][0]["in_catalogue"]
    return Counter({
        "hidden": 1, "hidden/silent": int(not entries and not classes), "hidden/where": int(where), "hidden/on what": int(what),
        "known law": int(inside), "known law/told": int(inside and law),
    })  # fmt: skip


def variables(entry: Entry, sealed: Sealed) -> list[str]:
    """Those that an entry says its torque depends on."""
    if "depends_on" in entry:
        return list(entry["depends_on"])
    names = [sealed.joints[j] for j in sealed.at(entry)]
    kinds = VARIABLES.get(entry["effect"], ())
    of_joint = {kind: [f"{kind}_{name}" for name in names] for kind in ("q", "dq")} | {
        "sign(dq)": [f"sign(dq_{name})" for name in names]
    }
    return [v for kind in kinds for v in of_joint.get(kind, [kind])]


def events(found: Mapping[str, Any], truth: Mapping[str, Any]) -> Counter[str]:
    """Pushes that are told, and events that are none; and errors of the times by which signals are late, in steps of 1 ms."""
    result = Counter[str]()
    true = [e | {"recording": file} for file, some in truth["events"].items() for e in some if not file.startswith("test/")]
    if "events" in found:
        pairs = [(a, b) for a in found["events"] for b in true if same_event(a, b)]
        hit = {id(b) for _, b in pairs}
        result.update({"pushes": len(true), "pushes/told": len(hit)})
        result.update({"events": len(found["events"]), "events/right": len({id(a) for a, _ in pairs})})
    for measured in found.get("measurement", {}).values():
        if measured.get("torque_late_s") is not None:
            near = abs(measured["torque_late_s"] - truth["torque_late_s"]) < 0.002
            result.update({"lags": 1, "lags/within 2 ms": int(near)})
    return result


def same_event(a: Entry, b: Entry) -> bool:
    """Whether two events are of one joint and overlap."""
    return a["joint"] == b["joint"] and a["recording"] == b["recording"] and a["from"] < b["to"] and b["from"] < a["to"]


def table(scores: Iterable[tuple[str, Counter[str]]]) -> str:
    """Counts by family: a row for each "a/b", as "b of a", and for what was claimed falsely."""
    families: dict[str, Counter[str]] = {}
    for family, counts in scores:
        for name in (family, "all"):
            families.setdefault(name, Counter()).update(counts)
    names = sorted(families, key=lambda name: (name == "all", name))
    keys = sorted({key for counts in families.values() for key in counts})
    lines = [" | ".join(["", *names]), " | ".join(["---"] * (len(names) + 1))]
    for key in keys:
        of = key.split("/")[0]
        if of == key:
            if not any(other.startswith(f"{key}/") for other in keys):
                lines.append(" | ".join([key, *(str(families[n][key] or "–") for n in names)]))
        else:
            shown = [f"{families[n][key]} of {families[n][of]}" if families[n][of] else "–" for n in names]
            lines.append(" | ".join([key.replace("/", ": "), *shown]))
    return "\n".join(lines)
