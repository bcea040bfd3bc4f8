"""The diagnosis as data: what `diagnosis.json` holds."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rrr_oc.calibration.calibrated_model import Term
from rrr_oc.diagnosis.findings import Finding, named
from rrr_oc.diagnosis.mismatch import FAR
from rrr_oc.diagnosis.procedure import Diagnosis
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.storage import number

FORMAT = "rrr_oc-diagnosis/1"


def to_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """The content of `diagnosis.json`."""
    model, joints = diagnosis.model, diagnosis.model.joints
    black_box = [f.term.effect.black_box for f in diagnosis.findings]

    def by_joint(pair: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
        before, after = (dict(zip(joints, map(number, values), strict=True)) for values in pair)
        return {"before": before, "after": after}

    return {
        "format": FORMAT,
        "verdict": diagnosis.verdict,
        "held_out": diagnosis.way,
        "mismatch": list(diagnosis.mismatch),
        "left_over": {j: x for j, x in zip(joints, diagnosis.above_noise, strict=False) if x > FAR},
        "effects": [_effect(diagnosis, i) for i, empirical in enumerate(black_box) if not empirical],
        "possible": [
            {**named(p.key, joints), "recordings": _files(diagnosis.recordings, p.groups), "probability": p.probability}
            for p in diagnosis.possible
        ],
        "not_confirmed": [{**named(f.key, joints), "probability": f.probability} for f in diagnosis.refuted],
        "unexplained": [_unexplained(diagnosis, i) for i, empirical in enumerate(black_box) if empirical],
        "priors_file": diagnosis.priors,
        "priors": [_prior(f, joints) for f in diagnosis.findings if f.prior],
        "suggested_recordings": [
            {"why": s.why, "separates": list(s.separates), "trajectory": f"suggested_{k}.csv"}
            for k, s in enumerate(diagnosis.suggestions, 1)
        ],
        "nrmse": {"calibration": by_joint(diagnosis.calibration), "held_out": by_joint(diagnosis.held_out)},
        "versions": dict(model.versions),
    }


def _prior(finding: Finding, joints: Sequence[str]) -> dict[str, Any]:
    """What was believed of an effect before, and whether its claim rests on that."""
    prior, units = finding.prior, {p.name: p.unit for p in finding.term.effect.parameters}
    assert prior is not None
    typical = {name: {"value": size, "unit": unit or units.get(name, "")} for name, (size, unit) in prior.typical.items()}
    return {
        **named(finding.key, joints),
        "probability": prior.probability,
        "typical": typical,
        "source": prior.source,
        "claim_rests_on_prior": finding.rests_on_prior,
    }


def _effect(diagnosis: Diagnosis, i: int) -> dict[str, Any]:
    finding, shares = diagnosis.findings[i], diagnosis.shares
    return {
        "effect": finding.term.effect.name,
        "joint": _names(finding.term.effect.joints, diagnosis.model.joints),
        "recordings": files_of(finding.term, diagnosis.recordings),
        "equation": finding.term.effect.equation,
        "parameters": _parameters(finding.term),
        "share_of_error": shares.share[i],
        "p_value": finding.p_value,
        "probability": finding.probability,
        "probability_of_itself": finding.alone,
        "nrmse": {"held_out_before": number(shares.before[i]), "held_out_after": number(shares.after[i])},
        "held_out_gain_nats": number(shares.gain[i]),
        "indistinguishable_from": list(dict.fromkeys(name for name, _ in finding.rivals)),
        "rivals": [{"effect": name, "joint": _names(j, diagnosis.model.joints)} for name, j in finding.rivals],
    }


def _unexplained(diagnosis: Diagnosis, i: int) -> dict[str, Any]:
    finding, joints = diagnosis.findings[i], diagnosis.model.joints
    effect = finding.term.effect
    named = [_variable(kind, j, joints) for kind, j in effect.depends_on]
    validity = [{"variable": _variable(kind, j, joints), "range": [low, high]} for (kind, j), low, high in effect.validity]
    joint, files = joints[effect.joints[0]], files_of(finding.term, diagnosis.recordings)
    some = "" if files == "all" else f" in {', '.join(files)}"
    return {
        "joint": joint,
        "depends_on": named,
        "recordings": files,
        "share_of_error": diagnosis.shares.share[i],
        "p_value": finding.p_value,
        "probability": finding.probability,
        "validity": validity,
        "description": f"a torque on {joint}{some} that depends on {' and '.join(named)} and that no effect of the catalogue explains; "
        f"the model carries it as {effect.words(finding.term.named)}{', valid in the ranges given' if validity else ''}",
    }


def _variable(kind: str, j: int, joints: Sequence[str]) -> str:
    if kind in ("load", "motor"):
        return "load_torque"
    if kind == "time":
        return "time"
    return f"sign(dq_{joints[j]})" if kind == "sign" else f"{kind}_{joints[j]}"


def files_of(term: Term, recordings: RecordingSet) -> str | list[str]:
    """The recordings that have an effect, as in the file."""
    if term.recordings == "all":
        return "all"
    return [r.file for r in recordings.recordings if term.holds_for(r)]


def _files(recordings: RecordingSet, groups: Sequence[str]) -> str | list[str]:
    return [r.file for r in recordings.recordings if r.group in groups] if groups else "all"


def _parameters(term: Term) -> dict[str, Any]:
    """Values with standard errors and intervals; the components of a vector or matrix under one name."""
    by_name = {p.name: (e.value, e.std, p.unit) for p, e in zip(term.effect.parameters, term.estimates, strict=True)}
    result: dict[str, Any] = {
        shown: {"value": _nested(names, by_name, 0), "std": _nested(names, by_name, 1), "unit": by_name[_first(names)][2]}
        for shown, names in term.effect.composed.items()
    }
    if result:
        return result
    for p, e in zip(term.effect.parameters, term.estimates, strict=True):
        interval = None if e.interval is None else list(e.interval)
        result[p.name] = {"value": e.value, "std": e.std, "unit": p.unit, "interval": interval}
    for option in term.effect.options:
        value = getattr(term.effect, option)
        result[option] = {"value": list(value) if isinstance(value, tuple) else value, "std": None, "unit": ""}
    return result


def _nested(names: Any, by_name: dict[str, tuple[Any, ...]], column: int) -> Any:
    """One column of the parameters' data in the nesting of their names."""
    return by_name[names][column] if isinstance(names, str) else [_nested(n, by_name, column) for n in names]


def _first(names: Any) -> str:
    return names if isinstance(names, str) else _first(names[0])


def _names(numbers: Sequence[int], joints: Sequence[str]) -> Any:
    named = [joints[j] for j in numbers]
    return None if not named else named[0] if len(named) == 1 else named
