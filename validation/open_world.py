"""What does the diagnosis say where the law that is missing is not in its catalogue?

    python validation/concealed/make_cases.py --only single --seed 7 --out cases
    python validation/open_world.py --cases cases --out results/open_world

Each sealed case with one effect of the catalogue is diagnosed by a catalogue that lacks this effect. A claim is right where the
plant's own Jacobian says that the claimed effect is equal to the true one on these data, as an offset is to a harness in a small range.
Claims are as good as the hidden law where the model that has them predicts the data as well as one with that law: where the error of no
joint is higher by the share that matters. Any other claim at 95 % is false. What should be said is an unexplained torque of the right
joint, or that the data cannot tell. A case that is done is not done again.
"""

import sys
import time
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import track
from scipy.stats import binomtest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.calibration.calibrated_model import CalibratedModel
from rrr_oc.commands.shared import Jobs
from rrr_oc.diagnosis.diagnosis_file import to_json
from rrr_oc.diagnosis.knobs import MATTERS
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.structures.search import StructureSearch
from rrr_oc.effects import CATALOGUE
from rrr_oc.effects.priors import Priors
from rrr_oc.errors import UserError, entry_point
from rrr_oc.parallel import unordered, workers
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.tables import markdown
from rrr_oc.storage import Made, write_json, write_text
from validation.concealed.naming import IMPERFECT, how_named, place, read

LEAST = 1.0  # times the noise, from which a hidden effect must not be passed over in silence
SAID = {
    "false": "a claim that is not equal to the truth",
    "equal": "an effect that is equal on these data",
    "as good": "laws that predict these data as well",
    "unexplained": "an unexplained torque of the right joint",
    "elsewhere": "an unexplained torque of another joint",
    "cannot tell": "that the data cannot tell",
    "nothing": "nothing",
}
console = Console()


def hidden(truth: Mapping[str, Any]) -> bool:
    """Whether a case has one effect and no small faults, which the catalogue could lack, strong enough to be seen."""
    effects = truth["effects"]
    if truth["kind"] == IMPERFECT or len(effects) != 1 or not effects[0]["in_catalogue"]:
        return False
    return (effects[0]["ratio"]["requested"] or 0.0) >= LEAST


def diagnosed(folder: Path, sealed: Path, out: Path) -> dict[str, Any]:
    """What is said of a case by a catalogue without its effect; a crash is a result, too."""
    file = out / f"{folder.name}.json"

    def made() -> None:
        (effect,) = read(sealed)["effects"]
        start = time.process_time()
        try:
            recordings = load_recordings(folder / "data")
            diagnosis = diagnose(recordings, priors=Priors(excluded=(effect["effect"],)))
            more = error_beside(recordings, diagnosis.model, effect["effect"]) if diagnosis.findings else None
            found: dict[str, Any] = {"diagnosis": to_json(diagnosis), "more_error": more}
        except Exception:
            found = {"crash": traceback.format_exc()}
        write_json(file, {"case": folder.name, "seconds": time.process_time() - start, **found})

    Made([file], folder.name, [Path(__file__), folder]).once(made)
    return read(file)


def error_beside(recordings: RecordingSet, model: CalibratedModel, law: str) -> float | None:
    """By what share the error of a model exceeds that of one with a law where the search finds it, on the joint where it does most.

    None where a search for nothing but that law does not find it.
    """
    others = tuple(name for name in CATALOGUE if name != law)
    _, fitter, every, plain = ready(recordings, Priors(excluded=others))
    search = StructureSearch.of(fitter, every)
    best = search.run(fitter.with_signs(fitter.fit(plain, fitter.data.links.none))).fitted
    if law not in [t.effect.name for t in best.extra]:
        return None
    there, here = (np.linalg.norm(fitter.data.residual(m), axis=1) for m in (fitter.closest(best).model, model))
    return float(np.max(here / np.maximum(there, 1e-12))) - 1


def said(truth: Mapping[str, Any], diagnosis: Mapping[str, Any], more: float | None = None) -> tuple[str, list[str]]:
    """Which of `SAID` a diagnosis says, the worst that applies, and its false claims.

    Args:
        more: The share by which its error exceeds that of a model with the hidden law.
    """
    (effect,) = truth["effects"]
    claims = diagnosis["effects"]
    wrong = [e for e in claims if not any(how_named(effect, x) for x in (e, *e["rivals"]))]
    if wrong and more is not None and more < MATTERS:
        return "as good", []
    if wrong:
        return "false", [" ".join((e["effect"], *place(e["joint"]))) for e in wrong]
    joints = place(effect["joint"])
    right = [not joints or u["joint"] in joints for u in diagnosis["unexplained"]]
    if claims:
        return "equal", []
    if right:
        return ("unexplained" if any(right) else "elsewhere"), []
    return ("cannot tell" if diagnosis["verdict"] == "cannot_tell" else "nothing"), []


def share(count: int, of: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if not of:
        return "none of none"
    interval = binomtest(count, of).proportion_ci(method="wilson")
    return f"{count} of {of}, {100 * interval.low:.0f} to {100 * interval.high:.0f} %"


def report(results: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> tuple[dict[str, Any], str]:
    """Numbers and text, from truths with results."""
    rows, every, instead = [], Counter[str](), Counter[str]()
    by_law: dict[str, Counter[str]] = {}
    claims = false = 0
    crashed = [r["case"] for _, r in results if "crash" in r]
    for truth, r in results:
        if r["case"] not in crashed:
            what, wrong = said(truth, r["diagnosis"], r["more_error"])
            by_law.setdefault(truth["effects"][0]["effect"], Counter())[what] += 1
            every[what] += 1
            instead.update(name.split()[0] for name in wrong)
            claims, false = claims + len(r["diagnosis"]["effects"]), false + len(wrong)
    for law, counts in sorted(by_law.items()):
        rows.append([f"`{law}`", str(sum(counts.values())), *(str(counts[what] or "") for what in SAID)])
    total = sum(every.values())
    rows.append(["all", str(total), *(str(every[what]) for what in SAID)])
    lines = [
        "# Hidden laws",
        "",
        f"{total} sealed cases, each diagnosed without the law that it has; {len(crashed)} crashed.",
        "",
    ]
    lines += markdown(["hidden law", "cases", *SAID.values()], rows).splitlines()
    lines += ["", f"Cases with a false claim: {share(every['false'], total)}."]
    lines.append(f"Claims that are false: {share(false, claims)}.")
    lines += ["", "What was claimed falsely: " + ", ".join(f"{n} `{name}`" for name, n in instead.most_common()) + "."] * bool(
        instead
    )
    seconds = sorted(r["seconds"] for _, r in results)
    lines += ["", f"Processor time of a case: {seconds[len(seconds) // 2]:.0f} s (median), {seconds[-1]:.0f} s (most)."]
    summary = {
        "cases": total, "crashed": crashed, "said": dict(every), "claims": claims, "false_claims": false,
        "by_law": {law: dict(counts) for law, counts in sorted(by_law.items())}, "instead": dict(instead),
    }  # fmt: skip
    return summary, "\n".join(lines) + "\n"


def main(
    cases: Annotated[Path, typer.Option(help="a folder that validation/concealed/make_cases.py made")],
    out: Annotated[Path, typer.Option(help="folder of the results")] = Path("results/open_world"),
    jobs: Jobs = -1,
    limit: Annotated[int | None, typer.Option(min=1, help="only so many cases, the first by id")] = None,
) -> None:
    """Diagnose sealed cases without the law that each has; writes cases/<id>.json, summary.json and report.md."""
    truths = {f.stem: read(f) for f in sorted((cases / "sealed").glob("*.json"))}
    some = [case for case, truth in truths.items() if hidden(truth)][:limit]
    if not some:
        raise UserError(f"{cases}: no cases with one effect; validation/concealed/make_cases.py --only single makes them")
    with workers(jobs):
        runs = unordered(diagnosed, [(cases / case, cases / "sealed" / f"{case}.json", out / "cases") for case in some])
        results = [(truths[r["case"]], r) for r in track(runs, "cases", total=len(some), console=console)]
    summary, text = report(results)
    write_json(out / "summary.json", summary)
    write_text(out / "report.md", text)
    console.print(Markdown(text))
    console.print(f"Everything is in {out}.", highlight=False, soft_wrap=True)


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
