"""Tables, as Markdown or as rows, and our results in the form of the paper's Tables 3 and 4 beside the printed numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

from rrr_oc.codesign.task import PHASES
from rrr_oc.data.published import published
from rrr_oc.effects import design_forms
from rrr_oc.effects.words import joint_words
from rrr_oc.model.metrics import decrease

SPRINGS = ("k_p2", "q_eq2", "k_p3", "q_eq3", "k_b", "q_0", "r_1", "r_2", "r_3")  # in the order of Table 4
NONE = "–"
Result = Mapping[str, Any]
Table = tuple[list[str], list[list[str]]]  # header and rows
Results = Mapping[
    str, Sequence[Result | None]
]  # by configuration, of each way that stands in a column; None where it has no result


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    first, *others = [[cell.replace("|", "\\|") for cell in line] for line in (header, *rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in (first, ["---"] * len(header), *others))


def table_3(
    ours: Results, joints: Sequence[str], total: str, digits: int, measured: bool = False, beside: bool = True
) -> Table:
    """Relative decrease of E1, RMS and peak load torque against stiff actuation [%], ours beside the paper's.

    Args:
        ours: Results with "E1_joint", "rms" and "peak" by joint, and their E1 under the key `total`.
        digits: Decimals of our numbers.
        measured: Whether to print the paper's real-world numbers instead of the simulated ones.
        beside: Whether the paper's numbers stand beside ours; not for a task that is none of its own.
    """
    paper = published()["real_world_percent" if measured else "decrease_percent"]
    columns = [
        (key, label, i) for key, label in (("E1_joint", "E1"), ("rms", "rms"), ("peak", "peak")) for i in range(len(joints))
    ]
    rows = []
    for name, results in ours.items():
        if name == "SA":
            continue
        printed, row = paper.get(name, {}), [name]
        for key, label, i in columns:
            falls = _decreases(results, ours["SA"], digits, lambda r, k=key, j=joints[i]: r[k][j])
            theirs = str(printed[label][i]) if i < len(printed.get(label, ())) else NONE
            row.append(_beside(falls, theirs if beside else None))
        falls = _decreases(results, ours["SA"], digits, lambda r: r[total])
        row.append(_beside(falls, None if measured or not beside else str(printed.get("E1_total", NONE))))
        rows.append(row)
    return ["", *[f"{what} {joint_words(joint)}" for what in ("E1", "RMS", "peak") for joint in joints], "E1 total"], rows


def _decreases(results: Sequence[Result | None], stiff: Sequence[Result | None], digits: int, read) -> list[str]:
    both = zip(results, stiff, strict=True)
    return [NONE if a is None or b is None else f"{100 * decrease(read(a), read(b)):.{digits}f}" for a, b in both]


def _beside(ours: Sequence[str], paper: str | None) -> str:
    return " | ".join([*ours, *([] if paper is None else [paper])])


def table_4(
    ours: Results,
    names: Sequence[str],
    digits: int,
    formats: tuple[str, str] | None = ("g", "g"),
    titles: Mapping[str, str] | None = None,
) -> Table:
    """Hardware and durations, ours beside the paper's.

    Args:
        ours: Results with "springs" (by name, SI) and "durations" [s] of the phases.
        names: Springs' names, one column each.
        digits: Decimals of our numbers.
        formats: Formats of the paper's springs and durations; None leaves them out, for a task that is none of its own.
        titles: What the columns are called, by spring's name; default the names.
    """
    paper, rows = published()["springs"], []
    for name, results in ours.items():
        printed, row = paper.get(name, {}), [name]
        for key in names:
            suffix, factor, _ = spring_unit(key)
            numbers = [None if r is None or key not in r["springs"] else r["springs"][key] * factor for r in results]
            row.append(_numbers(numbers, digits, printed.get(key + suffix), formats and formats[0]))
        for i, phase in enumerate(PHASES):
            numbers = [None if r is None else r["durations"][i] for r in results]
            row.append(_numbers(numbers, digits, printed.get(f"t_{phase}"), formats and formats[1], always=True))
        rows.append(row)
    called = titles or {}
    return ["", *[f"{called.get(n, n)} [{spring_unit(n)[2]}]" for n in names], *[f"t_{p} [s]" for p in PHASES]], rows


def _numbers(ours: Sequence[float | None], digits: int, paper: float | None, form: str | None, always: bool = False) -> str:
    """Our numbers and, unless `form` is None, the paper's; a single dash where there is none at all, unless `always`."""
    if not always and (paper is None or form is None) and all(v is None for v in ours):
        return NONE
    return _beside(
        [NONE if v is None else f"{v:.{digits}f}" for v in ours],
        None if form is None else NONE if paper is None else f"{paper:{form}}",
    )


def spring_unit(spring: str) -> tuple[str, float, str]:
    """Suffix of a spring's name in the published tables, factor from SI, and the unit to print."""
    quantities = {q.symbol: q for kind in design_forms().values() for q in kind.design.quantities}
    found = quantities.get(spring) or quantities.get(spring.rstrip("0123456789"))
    if found is None:
        return "", 1.0, "SI"
    shown = {"_deg": "°", "_mm": "mm", "_mrad_per_Nm": "mrad/Nm"}
    suffix = next((ending for ending in shown if found.key.endswith(ending)), "")
    return suffix, 1 / found.unit, shown.get(suffix, found.si)
