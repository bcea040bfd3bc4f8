"""Does `rrr-oc check` ever advise a wrong mend? Mistakes are put into recording sets that are right, and what is said is compared with them.

    python validation/wrong_columns.py SET… --out results/wrong_columns

Each set is a folder with recordings.json. Into each, one after the other, go these mistakes: signs, orders and units of columns,
angles counted from an earlier link, zeros, and a robot's file with a wrong axis, mass or mounting. "right": the mistake is named first;
"rival": it is named as about as good as another; "poor": torques are said to be explained no better than by a constant, and no mend is advised;
"silent": nothing is said; "wrong": only other mends are advised. The command fails where an advice is wrong.
"""

import itertools
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.errors import entry_point
from rrr_oc.model.metrics import WORTHLESS
from rrr_oc.recordings.consistency import Doubt, check_consistency
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.recording import RecordingSet
from rrr_oc.report.tables import markdown
from rrr_oc.storage import write_json, write_text

Case = tuple[str, RecordingSet, tuple[str, ...]]  # what is wrong, the set, and words of which a right answer has one


def columns(
    of: RecordingSet, q: np.ndarray | None = None, tau: np.ndarray | None = None, zero: np.ndarray | None = None
) -> RecordingSet:
    """The set with q times the positions and rates, tau times the torques, and zeros added, matrices (n, n) and (n,)."""
    n = of.robot.n
    q, tau, zero = np.eye(n) if q is None else q, np.eye(n) if tau is None else tau, np.zeros(n) if zero is None else zero
    changed = (replace(r, q=q @ r.q + zero[:, None], dq=q @ r.dq, ddq=q @ r.ddq, tau=tau @ r.tau) for r in of.recordings)
    return replace(of, recordings=tuple(changed))


def mistakes(of: RecordingSet) -> Iterator[Case]:
    """The set with each mistake."""
    n, names, robot = of.robot.n, of.joints, of.robot
    eye, one = np.eye(n), n == 1
    travel = np.max([np.ptp(r.q, axis=1) for r in of.recordings], axis=0)
    size = np.std(np.concatenate([r.tau for r in of.recordings], axis=1), axis=1)
    moving = [j for j in range(n) if travel[j] > 0.2 and size[j] > 0]
    yield "nothing", of, ()
    yield (
        "all torques",
        columns(of, tau=-eye),
        ("all torques fit with the opposite", *([f"tau_{names[0]} fits"] * one)),
    )
    yield (
        "all positions",
        columns(of, q=-eye),
        ("all positions and their rates fit with the opposite", *([f"q_{names[0]} and"] * one)),
    )
    for j in moving:
        flip = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        both = f"q_{names[j]}, its rates and tau_{names[j]} fit with the opposite signs"
        yield f"sign of torque {j + 1}", columns(of, tau=flip), (f"tau_{names[j]} fits with the opposite sign",)
        yield f"signs of {j + 1}", columns(of, q=flip, tau=flip), (both,)
        yield (
            f"unit of torque {j + 1}",
            columns(of, tau=np.diag(np.where(np.arange(n) == j, 100.0, 1.0))),
            (f"tau_{names[j]} is ",),
        )
    for i, j in itertools.pairwise(moving):
        swap, total, back = eye.copy(), eye.copy(), eye.copy()
        swap[[i, j]], total[j, i], back[i, j] = swap[[j, i]], 1.0, -1.0
        pair = f"tau_{names[i]} and tau_{names[j]}"
        yield f"torques {i + 1} and {j + 1}", columns(of, tau=swap), (f"{pair} fit when they are swapped",)
        yield f"joints {i + 1} and {j + 1}", columns(of, q=swap, tau=swap), (f"all columns of {names[i]} and {names[j]} fit",)
        yield f"angle {j + 1} from link {i}", columns(of, q=total), (f"q_{names[j]} fits as q_{names[i]} + ",)
        yield f"parallelogram {i + 1}, {j + 1}", columns(of, tau=back), (f"{pair} fit as torques of a parallelogram",)
    yield "all torques in mNm", columns(of, tau=1e3 * eye), ("all torques are 1", *(f"tau_{name} is " for name in names))
    for j in moving:
        for zero in (-90, 30):
            at = np.radians(zero) * (np.arange(n) == j)
            yield f"zero of {j + 1} by {zero}°", columns(of, zero=at), (f"q_{names[j]} fits with ", "gravity")
        axes = np.where(np.arange(n)[:, None] == j, np.roll(robot.axes, 1, axis=1), robot.axes)
        yield f"axis of {j + 1} in the file", replace(of, robot=replace(robot, axes=axes)), (f"when {names[j]} turns about",)
        light = np.where(np.arange(n) == j, 0.03, 1.0) * robot.inertial
        yield f"mass of {j + 1} in the file", replace(of, robot=replace(robot, inertial=light)), (f"when {robot.links[j]} is ",)
    turned = np.roll(robot.gravity, 1)
    for name, gravity in (("wall", turned), ("ceiling", -robot.gravity)):
        yield (
            f"on a {name}",
            replace(of, robot=replace(robot, gravity=gravity)),
            ('"gravity"', "with the opposite sign", "added to it"),
        )


def judged(doubts: tuple[Doubt, ...], nrmse: tuple[float, ...], right: tuple[str, ...]) -> str:
    """One of "right", "rival", "poor", "silent", "wrong"."""
    told = [doubt for doubt in doubts if doubt.kind not in ("excitation", "clock")]
    first = [doubt.said.partition("; about as good")[0] for doubt in told]
    rivals = [rival for doubt in told for rival in doubt.rivals]
    if not told:
        return ("right" if not right else "silent") if not np.nanmax(nrmse) > WORTHLESS else "right" if not right else "poor"
    if first and all(any(word in said for word in right) for said in first):
        return "right"
    return "rival" if any(word in said for said in [*first, *rivals] for word in right) else "wrong"


def main(
    sets: Annotated[list[Path], typer.Argument(help="folders with recordings.json")],
    out: Annotated[Path, typer.Option(help="folder for the results; replaced")] = Path("results/wrong_columns"),
) -> None:
    """Judge what `check` says of every mistake in every set."""
    rows = []
    for folder in sets:
        for name, wrong, right in mistakes(load_recordings(folder)):
            found = check_consistency(wrong)
            answer = judged(found.doubts, found.nrmse, right)
            said = " | ".join(d.said for d in found.doubts if d.kind not in ("excitation", "clock"))
            rows.append({"set": "/".join(folder.parts[-2:]), "mistake": name, "answer": answer, "said": said})
            typer.echo(f"{answer:7} {rows[-1]['set']:24} {name:28} {said[:230]}")
    counts = Counter(row["answer"] for row in rows)
    write_json(out / "wrong_columns.json", {"counts": counts, "rows": rows})
    write_text(out / "wrong_columns.md", markdown(["answer", "inputs"], [[answer, str(n)] for answer, n in counts.items()]))
    typer.echo(", ".join(f"{n} {answer}" for answer, n in counts.most_common()))
    raise typer.Exit(1 if counts["wrong"] else 0)


if __name__ == "__main__":
    entry_point(lambda: typer.run(main))()
