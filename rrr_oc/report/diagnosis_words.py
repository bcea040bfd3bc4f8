"""The verdict of a diagnosis in words, and how sure it is."""

from collections.abc import Mapping, Sequence
from typing import Any

from rrr_oc.diagnosis.findings import LESS_PROBABLE
from rrr_oc.diagnosis.knobs import CLAIM
from rrr_oc.effects import CATALOGUE

SURE = 0.999  # probability above which no closer number is shown; nearer to 1, digits that no recordings support
# Above both times the error within the fit and this NRMSE, held-out recordings count as badly
POOR_RATIO, POOR_NRMSE = 3.0, 0.2
# predicted and the verdict says so; doubled, a model that fits too few recordings passes as complete


def sentence(found: Mapping[str, Any]) -> str:
    """The verdict."""
    if found["verdict"] == "nothing_missing":
        poor = _unforeseen(found)
        few = f" But it predicts recordings left out of the fit badly ({poor}): these are too few or too short to show more."
        return "Nothing is missing: the calibrated model explains these recordings to their noise." + few * bool(poor)
    if not (found["effects"] or found["unexplained"]):
        names = " and ".join(m["joint"] for m in found["mismatch"] if m["significant"])
        return (
            f"Something is missing on {names}, where the error is far beyond the noise, and these recordings do not decide what: "
            "nothing that would explain it holds on recordings left out of the search."
        )
    names = _lacking(found)
    lacking = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    ratios = {j: b["ratio"]["value"] for j, b in found["bootstrap"].items() if b["ratio"]["value"] is not None}
    gain = ""
    if ratios:
        joint = min(ratios, key=lambda j: ratios[j])
        before, after = (found["bootstrap"][joint][k]["value"] for k in ("before", "after"))
        left_out = "recordings" if found.get("held_out") != "blocks" else "blocks of the recording"
        gain = f" On {left_out} left out of the fit the error of {joint}'s torque goes from {before:.1%} to {after:.1%} of its spread."
    if found["verdict"] == "cannot_tell":
        return f"Something is missing, and these recordings do not decide what: {lacking}, or others that do as well.{gain}"
    rest = [f"{x:.0f} times the noise on {joint}" for joint, x in found.get("left_over", {}).items()]
    left = f" What is left is still {' and '.join(rest)}: more is missing, or of another shape." if rest else ""
    return f"The calibrated model lacks {lacking}.{gain}{left}"


def _unforeseen(found: Mapping[str, Any]) -> str:
    """The joints whose held-out error is far above the error within the fit, with both."""
    inside, outside = (found["nrmse"][key]["before"] for key in ("calibration", "held_out"))
    poor = [j for j in inside if inside[j] and outside[j] and outside[j] > max(POOR_RATIO * inside[j], POOR_NRMSE)]
    return ", ".join(f"{j}: NRMSE {outside[j]:.2g} against {inside[j]:.2g}" for j in poor)


def _lacking(found: Mapping[str, Any]) -> list[str]:
    """What was found and where, in a few words; effects that only some recordings have are named once for all of them."""
    named = [(placed(e), e) for e in found["effects"]]
    named += [(f"a torque on {u['joint']} that depends on {' and '.join(u['depends_on'])}", u) for u in found["unexplained"]]
    files: dict[tuple[str, bool], set[str]] = {}
    for name, entry in named:
        files.setdefault((name, bool(some_recordings(entry))), set()).update(some_recordings(entry))
    return [name + f" in {len(there)} of the recordings" * some for (name, some), there in files.items()]


def on_prior(found: Mapping[str, Any]) -> list[str]:
    """A sentence for each claim that would not be made, had it been `LESS_PROBABLE` times less probable before the recordings."""
    named = [(placed(e), e["probability"]) for e in found["effects"]]
    named += [(f"a torque on {u['joint']} that no effect explains", u["probability"]) for u in found["unexplained"]]
    return [
        f"The claim of {name} ({percent(p)}) rests on the prior: had it been {LESS_PROBABLE:g} times less probable before these "
        f"recordings, it would be below {CLAIM:.0%} now, and not claimed."
        for name, p in named
        if p * (1 - CLAIM) < LESS_PROBABLE * CLAIM * (1 - p)
    ]


def not_claimed(found: Mapping[str, Any]) -> list[str]:
    """A sentence each on what is possible and on what held-out recordings do not confirm; none where there is nothing to say."""
    result = []
    if found.get("possible"):
        result.append(f"Possible, not claimed (below {CLAIM:.0%}): {_listed(found['possible'])}.")
    if found.get("not_confirmed"):
        result.append(
            f"Not confirmed on held-out recordings, not claimed: {_listed(found['not_confirmed'])}. All recordings together make it "
            "probable, but without some of them it is not found, or predicts those no better."
        )
    return result


def _listed(entries: Sequence[Mapping[str, Any]]) -> str:
    some = [
        f" in {', '.join(files)}" * bool(files)
        for files in ([] if "recordings" not in e else some_recordings(e) for e in entries)
    ]
    named = [f"{placed(e)}{where} ({percent(e['probability'])})" for e, where in zip(entries, some, strict=True)]
    return ", ".join(dict.fromkeys(named))


def percent(probability: float) -> str:
    """A probability; none is shown as certain."""
    if probability > SURE:
        return f"> {SURE:.1%}"
    return f"{probability:.1%}" if probability > CLAIM else f"{probability:.0%}"


def gain(nats: float | None) -> str:
    """A gain in nats."""
    return "–" if nats is None else f"{nats:+.0f}" if abs(nats) >= 10 else f"{nats:+.1f}"


def rivals(e: Mapping[str, Any]) -> list[str]:
    """What may be there in an effect's place, with its joint where that is another."""
    return [r["effect"].replace("_", " ") if r["joint"] == e["joint"] else placed(r) for r in e["rivals"]]


def placed(e: Mapping[str, Any]) -> str:
    """An effect and where it is."""
    joint, kind = e["joint"], CATALOGUE.get(e["effect"])
    where = "" if joint is None else joint if isinstance(joint, str) else " and ".join(joint)
    if kind is not None and kind.role == "black_box":
        return f"a torque on {where} that no effect explains"
    return e["effect"].replace("_", " ") + f" of {where}" * bool(where)


def some_recordings(entry: Mapping[str, Any]) -> list[str]:
    """The recordings that have it, none if all do."""
    return [] if entry["recordings"] == "all" else entry["recordings"]
