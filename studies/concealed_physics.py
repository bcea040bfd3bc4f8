"""Sealed cases of concealed physics: the diagnosis runs blind over them, then they are opened and it is scored.

    python validation/concealed/make_cases.py --out cases
    python studies/concealed_physics.py --cases cases --out results/concealed

The diagnosis of a case is given its `data` folder alone and is written to `out/cases/<id>.json` when it is whole, so that a run
that was interrupted goes on where it was; results of other recordings or other code are made anew. `unseen`, recordings of other
motions, serve to compare predictions afterwards. The truth is opened when no diagnosis is left to do, or with --score-only.

An effect counts as named where name and joint are right of what the diagnosis lists, claimed, undecided or small (of a single effect:
lists first), or of what it says cannot be told from that, or where what it lists is, by the plant's own Jacobian, equal to the truth on
these data.

An imperfect arm has small faults everywhere, and perhaps strong effects. Strong ones are to be named, first. A further claim is true
where the arm has that fault; it is wrong where neither that nor a strong effect is there, or where it is only the equal of one that
is named already. So is a stated probability judged. What is called unexplained on such an arm is counted, not judged.
"""

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import typer
from rich.markdown import Markdown
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from scipy.optimize import linear_sum_assignment, minimize
from scipy.special import expit, logit, xlogy
from scipy.stats import beta, chi2

from rrr_oc import parallel
from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.calibration.estimator.fitting import Fitted
from rrr_oc.calibration.prediction_error import evaluate_inverse
from rrr_oc.commands.shared import Jobs, Workers
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.fitting import Fitter
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.structures.candidates import Screen
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects import CATALOGUE, Effect, Trial
from rrr_oc.effects.base import Prior
from rrr_oc.effects.priors import Priors
from rrr_oc.errors import UserError, entry_point
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.console import wide_console
from rrr_oc.report.figures import save_figure
from rrr_oc.report.tables import markdown
from rrr_oc.storage import Made, write_json, write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from validation.concealed.naming import ABSENT, IMPERFECT, how_named, key, place, read, small

matplotlib.use("Agg")
import matplotlib.pyplot as plt

QUANTILES = (0.25, 0.5, 0.75, 0.95)
FEW = ("single", "faint", "short", "some", "alone", "current", "load", "identify", "locked")  # kinds with one effect at most
SEVERAL = ("pair", "triple", "outside_pair")
DETECTED = 1e-3  # p-value of a likelihood ratio
NEAR = 1.1  # error over the oracle's up to which a repaired model is as good
WIDER = 100.0  # times an effect's typical size: width of the oracle's prior; with less, strong effects come out too weak
BINS = (0.5, 0.8, 0.95, 1.0)  # of stated probabilities; the last one is of what is claimed
SLOPES, LAPSES = (0.3, 30.0), (0.0, 0.1)  # of the curve of what is named over the strength's logarithm
NORMAL = 1.96  # standard errors of a 95 % interval
NOTHING, UNEXPLAINED, FAILED = "nothing", "unexplained", "failed"
COSTS = ("median [s]", "longest [s]", "median [MB]", "most [MB]")  # columns of what a diagnosis takes
IMPERFECT_ROWS = {
    "strong_first": "the strong effect first (with two: both, before all others)",
    "every_strong_named": "every strong effect named",
    "something_not_there": "something that is not there was claimed",
    "something_unexplained": "something was called unexplained",
    "claims_that_are_there": "claims that are there",
    "coverage_of_small": "95 % intervals of small parts that hold the true value",
}  # shares of imperfect arms, and what the report calls them
CLEAR_REFS, STATUS = (
    Path("/proc/self/clear_refs"),
    Path("/proc/self/status"),
)  # where Linux resets and tells a process's peak memory
console = wide_console()


# --- blind ---


def diagnose_case(folder: Path, out: Path) -> str:
    """Diagnose the `data` of a case, predict its `unseen`, write both to `out`; the case's id. A crash is a result, too."""
    measurable, peak = forget_peak(), None
    start = time.perf_counter()
    try:
        diagnosis = diagnose(load_recordings(folder / "data"))
        wall, peak = time.perf_counter() - start, peak_memory() if measurable else None
        unseen = load_recordings(folder / "unseen")
        errors = {"before": mean_errors(diagnosis.plain, unseen), "after": mean_errors(diagnosis.model, unseen)}
        found: dict[str, Any] = {"diagnosis": to_json(diagnosis), "unseen": errors}
    except Exception:
        wall, found = time.perf_counter() - start, {"failed": traceback.format_exc()}
    write_json(out / f"{folder.name}.json", without_nan({"case": folder.name, "wall_s": wall, "peak_MB": peak, **found}))
    return folder.name


def forget_peak() -> bool:
    """Begin to measure this process's peak memory again, for a process diagnoses many cases; whether the system can (Linux)."""
    try:
        CLEAR_REFS.write_text("5", encoding="utf-8")
    except OSError:
        return False
    return True


def peak_memory() -> float | None:
    """Most memory that this process has held since `forget_peak` [MB], with what it kept from before."""
    lines = STATUS.read_text(encoding="utf-8").splitlines()
    return next((float(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith("VmHWM")), None)


def mean_errors(model: CalibratedModel, unseen: RecordingSet) -> dict[str, float | None]:
    """NRMSE of the predicted signal, mean over the recordings, by joint."""
    errors = evaluate_inverse(model, unseen).values()
    known = {j: [e[j]["nrmse"] for e in errors if e[j]["nrmse"] is not None] for j in model.joints}
    return {j: float(np.mean(v)) if v else None for j, v in known.items()}


def without_nan(x: Any) -> Any:
    """Plain data with null for what is no finite number."""
    if isinstance(x, Mapping):
        return {k: without_nan(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [without_nan(v) for v in x]
    return None if isinstance(x, float) and not np.isfinite(x) else x


def run_all(what: str, function: Callable[..., str], arguments: Mapping[str, Sequence[Any]], out: Path) -> None:
    """Call a function for the cases that have no result yet; its arguments by case, paths, less the folder of results."""
    made = {case: Made([out / f"{case}.json"], case, [Path(__file__), *a]) for case, a in arguments.items()}
    todo = [(*a, out) for case, a in arguments.items() if not made[case].there]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task(what, total=len(arguments), completed=len(arguments) - len(todo))
        for case in parallel.unordered(function, todo):
            made[case].keep()
            progress.update(bar, advance=1, description=f"{what} {case}")


def chosen(cases: Path, only: str | None, limit: int | None) -> list[Path]:
    """Folders of the cases, in the order of their ids; `only` picks a kind, of which the diagnosis is told nothing."""
    folders = sorted(f.parent for f in cases.glob("*/data") if (cases / "sealed" / f"{f.parent.name}.json").is_file())
    if only:
        folders = [f for f in folders if read(cases / "sealed" / f"{f.name}.json")["kind"] == only]
    if not folders:
        raise UserError(
            f"{cases}: no cases{f' of the kind {only!r}' if only else ''}; validation/concealed/make_cases.py makes them"
        )
    return folders[:limit]


# --- opened ---


def contained(truth: Mapping[str, Any], found: Sequence[Mapping[str, Any]]) -> bool:
    """Whether an effect that was found, if for another one, can be all that this one is: an offset is in a harness's rest."""
    same = [key(e) for e in (truth.get("equal_effects") or {}).get("equal", [])]
    return any(key(f) in same for f in found)


def outside_named(truth: Mapping[str, Any], unexplained: Sequence[Mapping[str, Any]]) -> bool:
    """Whether something is called unexplained on the right joint, by a variable that the truth depends on."""
    joints, variables = place(truth["joint"]), set(truth["depends_on"])
    return any((not joints or u["joint"] in joints) and variables & set(parts(u["depends_on"])) for u in unexplained)


def parts(names: Iterable[str]) -> list[str]:
    """Names of variables; a product is its factors."""
    return [part.strip() for name in names for part in name.split("*")]


def matched(truths: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]) -> list[tuple[int, str] | None]:
    """For each true effect which of the found ones names it, each at most once, and how."""
    if not truths or not found:
        return [None] * len(truths)
    worth = {"itself": 3.0, "rival": 2.0, "equal": 1.9, None: 0.0}
    ways = [[how_named(t, f) for f in found] for t in truths]
    rows, columns = linear_sum_assignment([[-worth[w] for w in row] for row in ways])
    result: list[tuple[int, str] | None] = [None] * len(truths)
    for i, k in zip(rows, columns, strict=True):
        way = ways[i][k]
        if way is not None:
            result[i] = int(k), way
    return result


def judged(truths: Sequence[Mapping[str, Any]], found: Sequence[Mapping[str, Any]]) -> list[bool]:
    """Which of the found effects are there: those that are among the true ones, and those that name one as `matched` has it."""
    named = {match[0] for match in matched(truths, found) if match is not None}
    true = [key(t) for t in truths]
    return [k in named or key(f) in true for k, f in enumerate(found)]


def claims(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What a diagnosis says is there or may be there, with its probability, if stated, and whether it is there.

    `right` is None for what an imperfect arm leaves unexplained. `size`: the truth's ratio, of a small part that is there.
    """
    effects, possible = diagnosis["effects"], diagnosis.get("possible") or []
    truths = [e for e in truth["effects"] if e["in_catalogue"]] + small(truth)
    sizes = {key(e): (e.get("ratio") or {}).get("reached") for e in small(truth)}
    entries, found = [], [*effects, *possible]
    equal = [any(how_named(t, f) == "equal" for t in truth["effects"] if not t["in_catalogue"]) for f in found]
    for k, (f, right) in enumerate(zip(found, judged(truths, found), strict=True)):
        entries.append({
            "effect": f["effect"], "joint": f["joint"], "claimed": k < len(effects), "right": right or equal[k],
            "probability": f.get("probability"), "size": sizes.get(key(f)),
        })  # fmt: skip
    outside = [e for e in truth["effects"] if not e["in_catalogue"]]
    for u in diagnosis["unexplained"]:
        right = None if truth["kind"] == IMPERFECT else any(outside_named(e, [u]) for e in outside)
        entry = {"effect": UNEXPLAINED, "joint": u["joint"], "claimed": True, "right": right}
        entries.append(entry | {"probability": u.get("probability"), "size": None})
    return entries


def links(diagnosis: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Links that are told to be off, as the effect that says so; a link's own joint is the last of its directions."""
    return [
        {"effect": "link_inertial", "joint": f["directions"][-1]["joint"], "recordings": "all", "parameters": {}, "rivals": []}
        for f in diagnosis.get("link_findings", [])
    ]


def oracle_case(folder: Path, sealed: Path, out: Path) -> str:
    """Fit the effects that a case really has, where and in the recordings that have them; the case's id.

    What is written: NRMSE on `unseen`, and how much each effect adds to twice the log-likelihood, with its number of parameters.
    """
    truth, recordings = read(sealed), load_recordings(folder / "data")
    kinds = [CATALOGUE[e["effect"]] for e in truth["effects"]]
    _, fitter, every, plain = ready(recordings, Priors({kind.name: of_any_size(kind) for kind in kinds}))
    fitted, entries = fitter.with_signs(fitter.fit(plain, fitter.data.links.none)), []
    for e in truth["effects"]:
        joints = sorted(recordings.joints.index(j) for j in place(e["joint"]))
        ways = [t for t in every if t.effect.name == e["effect"] and sorted(t.effect.joints) == joints]
        better = with_effect(fitter, fitted, ways, e["recordings"])
        growth = 0.0 if better is None else weighted_square(fitter, fitted, better) - weighted_square(fitter, better, better)
        parameters = 0 if better is None else len(better.model.terms[-1].estimates)
        entries.append({"effect": e["effect"], "likelihood": growth, "parameters": parameters})
        fitted = better or fitted
    errors = mean_errors(fitted.model, load_recordings(folder / "unseen"))
    write_json(out / f"{folder.name}.json", without_nan({"case": folder.name, "unseen": errors, "effects": entries}))
    return folder.name


def of_any_size(kind: type[Effect]) -> Prior:
    """The prior of an effect, so wide that it holds no amplitude back: who knows that an effect is there needs no typical size."""
    typical = kind.prior.typical or dict.fromkeys(kind.amplitudes, (1.0, ""))
    return replace(kind.prior, typical={name: (WIDER * size, unit) for name, (size, unit) in typical.items()})


def with_effect(fitter: Fitter, fitted: Fitted, ways: Sequence[Trial], recordings: Any) -> Fitted | None:
    """A model fitted with one effect more, in these recordings; None where none of its trials fits at all.

    It is fitted from the best candidate of all recordings and from the best one of some; the larger evidence counts.
    """
    if not ways:
        return None
    near = StructureSearch.of(fitter, ways).neighbours(fitted)
    here = near.at(near.linear.own, fitted.posterior.hyper, fixed=True)
    found = Screen.of(near.level, near.tables(None), here.structure, near.blocks, here.solution).candidates()
    starts = [next((c for c in found if (c.scope is None) is whole), None) for whole in (True, False)]
    fits = []
    for start in starts:
        if start is not None:
            term = replace(start.term, recordings="all" if recordings == "all" else tuple(recordings), groups=())
            model = replace(fitted.model, terms=(*fitted.model.terms, term))
            fits.append(fitter.with_signs(fitter.fit(model, fitted.links, fitted.posterior)))
    return max(fits, key=lambda f: f.log_evidence, default=None)


def weighted_square(fitter: Fitter, fitted: Fitted, other: Fitted) -> float:
    """Weighted square of a fit's residual, with noise and discrepancy of another fit, its parameters and links fitted anew to that.

    The links' errors add the square that their prior gives them. The difference of two fits under the noise of the better one is
    twice the logarithm of their likelihood ratio; the priors of the effects and their Occam factors do not enter.
    """
    again = fitter.fit(fitted.model, fitted.links, other.posterior, fixed=True)
    post, size = again.posterior, len(again.model.values)
    links = slice(size, size + len(again.links))
    off = (post.step - post.prior.mean)[links]
    return post.predicted(post.step) - post.prior_cost(post.step) + float(post.prior.precision[links] @ off**2)


def score_case(truth: Mapping[str, Any], result: Mapping[str, Any], oracle: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What became of one case; `oracle` as `oracle_case` wrote it. Effects of the catalogue that no data show do not count."""
    diagnosis = result.get("diagnosis") or {"verdict": FAILED, "effects": [], "unexplained": []}
    effects, unexplained, few = diagnosis["effects"], diagnosis["unexplained"], truth["kind"] in FEW
    classes = [{**u["members"][0], "rivals": u["members"][1:]} for u in diagnosis.get("undecided", [])]
    classes += links(diagnosis)
    told = [*effects, *classes, *diagnosis.get("small", [])]  # what is small is told, too
    inside = [e for e in truth["effects"] if e["in_catalogue"] and e.get("ratio", {}).get("reached", 1.0) > ABSENT]
    found = matched(inside, told[:1] if few else told)
    seen = [r["file"] for r in truth["recordings"] if not r["unseen"]]
    entries = []
    for e, match in zip(inside, found, strict=True):
        hit = None if match is None else told[match[0]]
        entry = {
            "effect": e["effect"],
            "ratio": e.get("ratio", {}).get("requested"),
            "named": match is not None,
            "how": "undecided"
            if hit in classes
            else match[1]
            if match is not None
            else "contained"
            if contained(e, told) and not few
            else None,
            "small": match is not None and match[0] >= len(effects) + len(classes),
            "recordings": hit is not None and files(hit["recordings"], seen) == files(e["recordings"], seen),
            "covered": covered(e, hit) if hit is not None and match is not None and match[1] == "itself" else [],
        }
        entries.append(entry)
    for e in truth["effects"]:
        if not e["in_catalogue"]:
            equal = any(how_named(e, f) == "equal" for f in effects)
            entries.append({
                "effect": e["effect"], "ratio": e["ratio"]["requested"], "named": outside_named(e, unexplained),
                "how": "equal" if equal else None, "outside": True, "covered": [],
            })  # fmt: skip
    first = effects[0]["effect"] if effects else UNEXPLAINED if unexplained else NOTHING
    strong_first = matched(inside, effects[: len(inside)])
    return {
        "case": truth["case"],
        "key": truth["key"],
        "kind": truth["kind"],
        "robot": truth["robot"],
        "joints": len(truth["joints"]),
        "true": entries,
        "found": [key(e)[0] + "".join(f" {j}" for j in key(e)[1]) for e in effects]
        + [f"{UNEXPLAINED} {u['joint']}: {', '.join(u['depends_on'])}" for u in unexplained],
        "first": FAILED if "failed" in result else first,
        "strong_first": all(match is not None for match in strong_first) if inside else None,
        "claims": claims(truth, diagnosis),
        "covered_small": [c for e in small(truth) for f in effects if key(f) == key(e) for c in covered(e, f)],
        "extra": len(effects)
        + len(unexplained)
        - sum(e["named"] and not e.get("small") and e["how"] != "undecided" for e in entries),
        "alarm": diagnosis["verdict"] != "nothing_missing",
        "silent": diagnosis["verdict"] == "cannot_tell",
        "members": [1 + len(e["rivals"]) for e in diagnosis["effects"]],
        "unseen": mean_over_joints(
            result.get("unseen") and result["unseen"] | ({"oracle": oracle["unseen"]} if oracle else {})
        ),
        "visible": visible(oracle),
        "wall_s": result["wall_s"],
        "peak_MB": result.get("peak_MB"),
    }


def visible(oracle: Mapping[str, Any] | None) -> float | None:
    """How many times as strong as needed a lone effect is, for one who knows what to look for to detect it (p < 1e-3).

    The likelihood grows with the square of the strength.
    """
    if oracle is None or len(oracle["effects"]) != 1 or not oracle["effects"][0]["parameters"]:
        return None
    (effect,) = oracle["effects"]
    return float(np.sqrt(max(effect["likelihood"], 0.0) / chi2.isf(DETECTED, effect["parameters"])))


def files(recordings: Any, seen: Sequence[str]) -> set[str]:
    """Names of recordings among those that the tool saw."""
    return set(seen) if recordings in ("all", "each") else set(recordings) & set(seen)


def covered(truth: Mapping[str, Any], found: Mapping[str, Any]) -> list[bool]:
    """For each number that both have and the tool gives an interval for, whether that holds the true value."""
    result = []
    for name, p in found["parameters"].items():
        true = truth["parameters"].get(name, {}).get("value")
        if "value" not in p:
            continue  # another in every recording
        for value, std, interval, t in zip(*map(flat, (p["value"], p["std"])), intervals(p), flat(true), strict=False):
            if not isinstance(t, float | int) or not isinstance(value, float | int):
                continue
            if interval is None and std is None:
                continue  # the recordings do not decide it
            low, high = (value - NORMAL * std, value + NORMAL * std) if interval is None else interval
            turns = 2 * np.pi * np.round((value - t) / (2 * np.pi)) if name == "phase" else 0.0
            result.append(bool(low <= t + turns <= high))
    return result


def flat(x: Any) -> list[Any]:
    """The numbers of a parameter; of a symmetric matrix each once."""
    if not isinstance(x, list):
        return [x]
    square = all(isinstance(y, list) for y in x)
    return [v for k, y in enumerate(x) for v in (y[k:] if square else flat(y))]


def intervals(parameter: Mapping[str, Any]) -> list[tuple[float, float] | None]:
    given = parameter.get("interval")
    return [None] * len(flat(parameter["value"])) if not given else [(given[0], given[1])]


def mean_over_joints(unseen: Mapping[str, Mapping[str, float | None]] | None) -> dict[str, float] | None:
    if unseen is None:
        return None
    return {when: float(np.mean([v for v in by_joint.values() if v is not None])) for when, by_joint in unseen.items()}


def share(flags: Sequence[bool]) -> dict[str, Any]:
    """How many of how many, with the 95 % interval of Clopper and Pearson."""
    k, n = sum(flags), len(flags)
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return {"of": n, "count": k, "share": k / n if n else None, "interval": [low, high] if n else None}


def summarise(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """All numbers of the report."""
    of = {kind: [s for s in scores if s["kind"] == kind] for kind in sorted({s["kind"] for s in scores})}

    def inside(s: Mapping[str, Any]) -> list[Mapping[str, Any]]:
        return [e for e in s["true"] if not e.get("outside")]

    strengths = sorted({(k, e["ratio"]) for k in of if k in FEW for s in of[k] for e in inside(s) if e["ratio"]}, reverse=True)
    named = {
        f"{kind}, {ratio:g} times the noise": share([e["named"] for s in of[kind] for e in inside(s) if e["ratio"] == ratio])
        for kind, ratio in strengths
    }
    every = {k: share([all(e["named"] for e in inside(s)) for s in of[k] if inside(s)]) for k in SEVERAL if k in of}
    told = [all(e["named"] or e["how"] == "contained" for e in inside(s)) for k in SEVERAL for s in of.get(k, []) if inside(s)]
    outside = [(s, e) for s in scores for e in s["true"] if e.get("outside")]
    clean = [s for s in scores if not s["true"] and s["kind"] != IMPERFECT]
    before_after = [s["unseen"] for s in scores if s["unseen"] and s["true"]]
    effects = sorted({e["effect"] for s in scores for e in s["true"]})
    return {
        "cases": len(scores),
        "failed": [s["case"] for s in scores if s["first"] == FAILED],
        "named": named,
        "every_effect_named": every,
        "every_effect_that_can_be_told": share(told),
        "how": dict(Counter(e["how"] for s in scores for e in inside(s) if e["named"])),
        "recordings_right": share(
            [e["named"] and e["recordings"] for k in ("some", "alone") for s in of.get(k, []) for e in inside(s)]
        ),
        "outside_unexplained": share([e["named"] for _, e in outside]),
        "outside_or_equal": share([e["named"] or e["how"] == "equal" for _, e in outside]),
        "false_alarms": share([s["alarm"] for s in clean]),
        "with_extra_effects": share([s["extra"] > 0 for s in scores if s["true"] and s["kind"] != IMPERFECT]),
        "cannot_tell": {
            kind: share([s["silent"] for s in scores if s["kind"] == kind]) for kind in sorted({s["kind"] for s in scores})
        },
        "members": float(np.mean([m for s in scores for m in s["members"]] or [np.nan])),
        "coverage": share([c for s in scores for e in s["true"] for c in e["covered"]]),
        "imperfect": of_imperfect_arms(of.get(IMPERFECT, [])),
        "reliability": {"all": reliability(scores), IMPERFECT: reliability(of.get(IMPERFECT, []))},
        "unseen_nrmse": quartiles(before_after),
        "near_oracle": share([p["after"] <= NEAR * p["oracle"] for p in before_after if "oracle" in p]),
        "sensitivity": sensitivity(scores),
        "seconds": {
            f"{n} joints": [float(x) for x in np.quantile([s["wall_s"] for s in scores if s["joints"] == n], [0.5, 1.0])]
            for n in sorted({s["joints"] for s in scores})
        },
        "by_kind": {kind: cost_of(group) for kind, group in of.items()},
        "by_effect": {
            name: cost_of([s for s in scores if any(e["effect"] == name for e in s["true"])])
            | {
                "named": share([e["named"] for s in scores for e in s["true"] if e["effect"] == name]),
                "coverage": share([c for s in scores for e in s["true"] if e["effect"] == name for c in e["covered"]]),
            }
            for name in effects
        },
        "scores": list(scores),
    }


def cost_of(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Median and largest wall time and peak memory; the latter where it is known."""
    memory = [s["peak_MB"] for s in scores if s["peak_MB"] is not None]
    middle_and_top = [float(x) for x in np.quantile(memory, [0.5, 1.0])] if memory else None
    return {
        "cases": len(scores),
        "seconds": [float(x) for x in np.quantile([s["wall_s"] for s in scores], [0.5, 1.0])],
        "peak_MB": middle_and_top,
    }


def of_imperfect_arms(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Strong effects named, each and first; what else was claimed, and whether it is there."""
    claimed = [c for s in scores for c in s["claims"] if c["claimed"]]
    absent = [c["effect"] for c in claimed if c["right"] is False]
    strong = [s for s in scores if s["true"]]
    return {
        "strong_first": share([s["strong_first"] for s in strong if s["strong_first"] is not None]),
        "every_strong_named": share([all(e["named"] for e in s["true"]) for s in strong]),
        "something_not_there": share([any(c["claimed"] and c["right"] is False for c in s["claims"]) for s in scores]),
        "something_unexplained": share([any(c["effect"] == UNEXPLAINED for c in s["claims"]) for s in scores]),
        "claims_that_are_there": share([c["right"] for c in claimed if c["right"] is not None]),
        "not_there": dict(Counter(absent).most_common()),
        "coverage_of_small": share([c for s in scores for c in s["covered_small"]]),
    }


def reliability(scores: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By bins of the stated probability: how many, their mean, and the share that is right."""
    stated = [c for s in scores for c in s["claims"] if c["probability"] is not None and c["right"] is not None]
    bins = []
    for low, high in pairwise(BINS):
        inside = [c for c in stated if low <= c["probability"] < high or c["probability"] == high == BINS[-1]]
        mean = float(np.mean([c["probability"] for c in inside])) if inside else None
        bins.append({"from": low, "to": high, "stated": mean, "right": share([c["right"] for c in inside])})
    return bins


def quartiles(pairs: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    """Quartiles over cases of the NRMSE with the plain and the repaired model, of their ratio, and of that to the oracle's."""
    if not pairs:
        return {}
    before, after = (np.array([p[k] for p in pairs]) for k in ("before", "after"))
    rows = {"plain": before, "repaired": after, "repaired / plain": after / before}
    known = np.array([p["after"] / p["oracle"] for p in pairs if "oracle" in p])
    if len(known):
        rows["repaired / oracle"] = known
    return {name: [float(x) for x in np.quantile(values, QUANTILES)] for name, values in rows.items()}


def lone(scores: Sequence[Mapping[str, Any]]) -> list[tuple[float, str, bool]]:
    """Of each case with one effect that the oracle has looked for: how visible it is, its name, whether it was named.

    Not of imperfect arms, where what the oracle does not know of tells more than the noise."""
    return [
        (s["visible"], s["true"][0]["effect"], s["true"][0]["named"])
        for s in scores
        if s["visible"] and len(s["true"]) == 1 and s.get("kind") != IMPERFECT
    ]


def sensitivity(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Strength at which half of the lone effects are named, over the one at which the oracle detects them; of each effect, too.

    A logistic curve over the strength's logarithm that levels off below one by the share that is missed however strong it is
    (Wichmann and Hill, Perception & Psychophysics 63, 2001, https://doi.org/10.3758/BF03194544). An effect's own curve shares the
    slope and that lapse; its half is sought among the strengths at which the effect was looked for, and at their ends is a bound.
    """
    cases = lone(scores)
    if len({named for *_, named in cases}) < 2:
        return None
    strength, named = np.log([v for v, *_ in cases]), np.array([n for *_, n in cases])
    names = np.array([name for _, name, _ in cases])

    def cost(half: float, slope: float, lapse: float, rows: Any = slice(None)) -> float:
        p = (1 - lapse) * expit(slope * (strength[rows] - half) + logit(0.5 / (1 - lapse)))
        return -float(np.sum(xlogy(named[rows], p) + xlogy(~named[rows], 1 - p)))

    ends = (strength.min(), strength.max())
    found = minimize(lambda p: cost(*p), [0.0, 3.0, 0.02], method="Nelder-Mead", bounds=[ends, SLOPES, LAPSES])
    half, slope, lapse = found.x
    by_effect = {}
    for name in sorted(set(names)):
        rows = names == name
        grid = np.linspace(strength[rows].min(), strength[rows].max(), 200)
        best = int(np.argmin([cost(x, slope, lapse, rows) for x in grid]))
        by_effect[name] = {
            "half_named": float(np.exp(grid[best])),
            "bound": {0: "at most", 199: "at least"}.get(best),
            "of": int(rows.sum()),
        }
    return {"half_named": float(np.exp(half)), "slope": slope, "lapse": lapse, "cases": len(cases), "by_effect": by_effect}


def confusion(scores: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """True effects, answers, and counts, of the cases with one effect; what was named in any way counts as itself."""
    pairs = []
    for s in scores:
        if len(s["true"]) == 1:
            e = s["true"][0]
            right = UNEXPLAINED if e.get("outside") else e["effect"]
            pairs.append((e["effect"], right if e["named"] else s["first"]))
        elif not s["true"] and s["kind"] != IMPERFECT:
            pairs.append((NOTHING, s["first"]))
    rows = sorted({t for t, _ in pairs})
    columns = [*[r for r in rows if any(f == r for _, f in pairs)], *sorted({f for _, f in pairs} - set(rows))]
    counts = np.zeros((len(rows), len(columns)), int)
    for t, f in pairs:
        counts[rows.index(t), columns.index(f)] += 1
    return rows, columns, counts


def draw_confusion(scores: Sequence[Mapping[str, Any]]) -> Any:
    """The confusion matrix, shares of each row as colour, counts as numbers."""
    rows, columns, counts = confusion(scores)
    figure, axis = plt.subplots(figsize=(2.5 + 0.36 * len(columns), 2.0 + 0.3 * len(rows)))
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    if counts.size:
        axis.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, k in np.argwhere(counts):
        colour = "white" if shares[i, k] > 0.5 else "black"
        axis.text(k, i, str(counts[i, k]), ha="center", va="center", fontsize=7, color=colour)
    axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axis.set_yticks(range(len(rows)), rows, fontsize=8)
    axis.set(xlabel="answer", ylabel="truth", title="Cases with one effect or none")
    figure.tight_layout()
    return figure


def draw_reliability(summary: Mapping[str, Any]) -> Any:
    """Stated against observed probabilities, and the coverage of 95 % intervals by effect; bars are 95 % intervals."""
    covered = {k: v["coverage"] for k, v in summary["by_effect"].items() if v["coverage"]["of"]}
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, max(4.2, 1.2 + 0.24 * len(covered))))
    left.plot([BINS[0], 1], [BINS[0], 1], color="grey", linewidth=0.8)
    for (of, bins), colour in zip(summary["reliability"].items(), ("tab:blue", "tab:orange"), strict=True):
        known = [b for b in bins if b["stated"] is not None]
        if known:
            x, y = [b["stated"] for b in known], [b["right"]["share"] for b in known]
            left.errorbar(x, y, yerr=bars([b["right"] for b in known]), fmt="o-", capsize=3, color=colour, label=of)
            for b in known:
                left.annotate(
                    f"{b['right']['of']}", (b["stated"], b["right"]["share"]), textcoords="offset points", xytext=(5, -11)
                )
    if left.has_data() and left.get_legend_handles_labels()[0]:
        left.legend()
    left.set(xlabel="stated probability", ylabel="share that is there", xlim=(BINS[0], 1.02), ylim=(0, 1.02), title="Claims")
    places = range(len(covered))
    shares = [c["share"] for c in covered.values()]
    right.errorbar(shares, places, xerr=bars(list(covered.values())), fmt="o", capsize=2)
    right.axvline(0.95, color="grey", linewidth=0.8)
    right.set_yticks(places, [f"{name} ({c['of']})" for name, c in covered.items()], fontsize=8)
    right.set(xlabel="95 % intervals that hold the true value", xlim=(0, 1.02), title="Parameters")
    figure.tight_layout()
    return figure


def bars(shares: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Lengths of the intervals below and above the shares, (2, N), as Matplotlib wants them."""
    middle, ends = np.array([s["share"] for s in shares]), np.array([s["interval"] for s in shares]).reshape(-1, 2)
    return np.maximum([middle - ends[:, 0], ends[:, 1] - middle], 0.0)


def report(summary: Mapping[str, Any]) -> str:
    """The report in Markdown."""
    rows = [
        *summary["named"].items(),
        *((f"{kind}: every effect", s) for kind, s in summary["every_effect_named"].items()),
        ("several: every effect, or it is contained in one that was named", summary["every_effect_that_can_be_told"]),
        ("effects in some recordings: named, and the recordings right", summary["recordings_right"]),
        ("outside the catalogue: unexplained, joint and variable right", summary["outside_unexplained"]),
        ("… or named by an effect that is equal on these data", summary["outside_or_equal"]),
        ("false alarms where nothing is missing", summary["false_alarms"]),
        ("cases with an effect in which more was found", summary["with_extra_effects"]),
        ("95 % intervals that hold the true value", summary["coverage"]),
        *((f"{kind}: “cannot tell” was said", s) for kind, s in summary["cannot_tell"].items()),
        *((f"imperfect: {name}", summary["imperfect"][k]) for k, name in IMPERFECT_ROWS.items()),
        (f"error on unseen motions at most {NEAR:g} times the oracle's", summary["near_oracle"]),
    ]
    lines = ["# Concealed physics", "", f"{summary['cases']} sealed cases, {len(summary['failed'])} of them failed.", ""]
    lines += [markdown(["", "of", "share", "its own 95 % interval"], [row(*r) for r in rows])]
    lines += [f"A claim has {summary['members']:.2f} members in the mean: itself, and what cannot be told from it.", ""]
    how = ", ".join(f"{n} as {w}" for w, n in summary["how"].items()) or "none"
    lines += [f"Named: {how} (`rival`: listed as indistinguishable; `equal`: equal on these data by the plant's Jacobian).", ""]
    if summary["unseen_nrmse"]:
        lines += ["NRMSE on recordings of other motions, mean over joints, quantiles over the cases with an effect:", ""]
        table = [[k, *(f"{x:.3f}" for x in v)] for k, v in summary["unseen_nrmse"].items()]
        lines += [markdown(["", *(f"{100 * x:g} %" for x in QUANTILES)], table)]
    curve = summary["sensitivity"]
    if curve:
        lines += [
            f"Half of the lone effects are named at {curve['half_named']:.2f} times the strength at which one who knows what to look "
            f"for detects them (p < {DETECTED:g}; {curve['cases']} cases, of which {percent(curve['lapse'])} are missed however strong).",
            "",
        ]
    lines += [*not_there(summary["imperfect"]), *reliability_tables(summary["reliability"]), *cost_tables(summary)]
    lines += ["`half at`: the same of each effect; a bound where all or none of its cases were named.", ""]
    effects = []
    for name, s in summary["by_effect"].items():
        c, half = s["coverage"], curve and curve["by_effect"].get(name)
        at = f"{half['bound'] or ''} {half['half_named']:.2f}".strip() if half else ""
        effects.append([*row(name, s["named"]), at, str(c["of"]), percent(c["share"]), *cost_row(s)[1:]])
    head = ["effect", "of", "named", "its own 95 % interval", "half at", "intervals", "hold", *COSTS]
    lines += [markdown(head, effects)]
    cases = [[s["case"], s["key"], "; ".join(s["found"]) or str(s["first"])] for s in summary["scores"] if missed(s)]
    lines += ["## Missed", "", markdown(["case", "key", "found"], cases)]
    return "\n".join([*lines, "![confusion](confusion.png)", "", "![reliability](reliability.png)"]) + "\n"


def missed(s: Mapping[str, Any]) -> bool:
    """Whether a case was judged wrongly: something was not named, or something was claimed that is not there."""
    if not all(e["named"] for e in s["true"]):
        return True
    if s["kind"] == IMPERFECT:
        return any(c["claimed"] and c["right"] is False for c in s["claims"])
    return s["alarm"] and not s["true"]


def not_there(imperfect: Mapping[str, Any]) -> list[str]:
    """What was claimed of imperfect arms that they do not have."""
    if not imperfect["not_there"]:
        return []
    counts = ", ".join(f"{n} {name}" for name, n in imperfect["not_there"].items())
    return [f"Claimed of imperfect arms and not there: {counts}.", ""]


def reliability_tables(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Stated and observed probabilities, of all cases and of imperfect arms; nothing where none is stated."""
    lines = []
    for of, bins in found.items():
        if any(b["stated"] is not None for b in bins):
            table = [
                [f"{b['from']:g} to {b['to']:g}", percent(b["stated"]), *row("", b["right"])[1:]]
                for b in bins
                if b["stated"] is not None
            ]
            lines += [markdown([f"probability, {of}", "mean", "of", "right", "its own 95 % interval"], table)]
    return lines


def cost_row(cost: Mapping[str, Any]) -> list[str]:
    """Cases, seconds and megabytes."""
    memory = [f"{x:.0f}" for x in cost["peak_MB"] or []] or ["", ""]
    return [str(cost["cases"]), *(f"{x:.1f}" for x in cost["seconds"]), *memory]


def cost_tables(summary: Mapping[str, Any]) -> list[str]:
    """Time and memory of a diagnosis, by number of joints and by kind."""
    seconds = [[k, f"{a:.1f}", f"{b:.1f}"] for k, (a, b) in summary["seconds"].items()]
    kinds = [[kind, *cost_row(cost)] for kind, cost in summary["by_kind"].items()]
    return [markdown(["time per case", "median [s]", "longest [s]"], seconds), markdown(["kind", "cases", *COSTS], kinds)]


def row(name: str, s: Mapping[str, Any]) -> list[str]:
    interval = "" if s["interval"] is None else " … ".join(percent(x) for x in s["interval"])
    return [name, str(s["of"]), percent(s["share"]), interval]


def percent(x: float | None) -> str:
    return "" if x is None else f"{100 * x:.1f} %"


def open_cases(cases: Path, folders: Sequence[Path], results: Path) -> list[dict[str, Any]]:
    """The scores of the cases that have a result."""
    done = [f.name for f in folders if (results / f"{f.name}.json").exists()]
    oracles = {f.stem: read(f) for f in (results.parent / "oracle").glob("*.json")}
    return [
        score_case(read(cases / "sealed" / f"{case}.json"), read(results / f"{case}.json"), oracles.get(case)) for case in done
    ]


def has_oracle(cases: Path, case: str) -> bool:
    """Whether all that a case conceals is in the catalogue."""
    effects = read(cases / "sealed" / f"{case}.json")["effects"]
    return bool(effects) and all(e["in_catalogue"] for e in effects)


def main(
    cases: Annotated[Path, typer.Option(help="a folder that validation/concealed/make_cases.py made")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/concealed"),
    jobs: Jobs = -1,
    workers: Workers = parallel.LOCAL,
    limit: Annotated[int | None, typer.Option(min=1, help="only so many cases, the first by id")] = None,
    only: Annotated[str | None, typer.Option(help="only cases of this kind, as single, clean, pair")] = None,
    score_only: Annotated[bool, typer.Option("--score-only", help="diagnose nothing more; score what there is")] = False,
) -> None:
    """Diagnose sealed cases, then open and score them; writes cases/<id>.json, summary.json, report.md and two figures."""
    folders = chosen(cases, only, limit)
    if not score_only:
        known = {f.name: (f, cases / "sealed" / f"{f.name}.json") for f in folders if has_oracle(cases, f.name)}
        with parallel.workers(jobs, workers):
            run_all("diagnosing", diagnose_case, {f.name: (f,) for f in folders}, out / "cases")
            run_all("the oracle", oracle_case, known, out / "oracle")
    scores = open_cases(cases, folders, out / "cases")
    if not scores:
        raise UserError(f"{out / 'cases'}: no results of these cases; run without --score-only first")
    summary = summarise(scores)
    write_json(out / "summary.json", summary)
    text = report(summary)
    write_text(out / "report.md", text)
    save_figure(draw_confusion(scores), out / "confusion.png", dpi=110)
    save_figure(draw_reliability(summary), out / "reliability.png", dpi=110)
    console.print(Markdown(text))
    console.print(f"Everything is in {out}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
