"""Who named what is concealed: the claims of `discovery.py` against the sealed truth, judged alike for all.

A claim is right where the project's own score would have it (`validation/concealed/naming.py`): effect and joint are those of the truth,
or, by the independent plant's own Jacobian, equal to it on these data. A term that may mean several effects is right if one of them
is, and of an effect that belongs to no single joint, a term on any joint is. What the project's tool lists as rivals does not count
here, but in a column of its own. On an imperfect arm, which has small faults everywhere, naming one of these is no false alarm.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rrr_oc.effects import CATALOGUE
from validation.concealed.naming import ABSENT, how_named, place, small
from validation.peers.discovery import OURS, PEERS

PLAIN, ALL_OURS = "plain model", "rrr_oc, diagnose"


def names(truth: Mapping[str, Any], claim: Mapping[str, Any], rivals: bool = False) -> bool:
    """Whether a claim names an effect of the truth."""
    for effect in claim["effects"]:
        joints = [claim["joint"], None] if CATALOGUE[effect].placement == "arm" else [claim["joint"]]
        for joint in joints:
            found = {"effect": effect, "joint": joint, "rivals": claim.get("rivals", []) if rivals else []}
            if how_named(truth, found) is not None:
                return True
    return False


def of_case(truth: Mapping[str, Any], found: Mapping[str, Any], plain: float) -> dict[str, Any]:
    """What became of one case with one way: what its first claim is worth, what it claims beyond, errors and time."""
    truths = [e for e in truth["effects"] if (e.get("ratio") or {}).get("reached", 1.0) > ABSENT]
    claims, there = found["claims"], truths + small(truth)
    wrong = sum(not any(names(t, c, True) for t in there) for c in claims)
    result: dict[str, Any] = {"error": found["nrmse"] / plain, "seconds": found["seconds"], "claims": len(claims)}
    if not truths:
        return result | {"alarm": wrong > 0}
    first = claims[:1]
    placed = [t for t in truths if place(t["joint"])]
    return result | {
        "first": any(names(t, c) for t in truths for c in first),
        "first_or_rival": any(names(t, c, True) for t in truths for c in first),
        "among": any(names(t, c) for t in truths for c in claims),
        "joint": any(set(place(t["joint"])) & set(place(c["joint"])) for t in placed for c in first) if placed else None,
        "beyond": wrong,
    }


def scored(cases: Path, out: Path) -> dict[str, list[dict[str, Any]]]:
    """Of each way what became of each case that both the project's tool and the peers have done."""
    done = {way: {p.stem: p for p in (out / "discovery" / way).glob("*.json")} for way in (OURS, PEERS)}
    result: dict[str, list[dict[str, Any]]] = {}
    for case in sorted(set(done[OURS]) & set(done[PEERS])):
        sealed = cases / "sealed" / f"{case}.json"
        if not sealed.is_file():
            continue
        truth, ours, peers = (json.loads(p.read_text(encoding="utf-8")) for p in (sealed, done[OURS][case], done[PEERS][case]))
        ways = {ALL_OURS: ours} | {k: v | {"seconds": v["seconds"] + peers["prepare_s"]} for k, v in peers["ways"].items()}
        for way, found in ways.items():
            entry = of_case(truth, found, peers["plain"])
            result.setdefault(way, []).append(entry | {"case": case, "key": truth["key"], "joints": len(truth["joints"])})
    return result


def share(entries: Iterable[Mapping[str, Any]], key: str) -> str:
    """How many of the entries that have a key have it true."""
    known = [bool(e[key]) for e in entries if e.get(key) is not None]
    return f"{sum(known)} of {len(known)}" if known else "–"


def middle(entries: Iterable[Mapping[str, Any]], key: str, form: str) -> str:
    """Median and largest of a number."""
    values = [float(e[key]) for e in entries if e.get(key) is not None]
    return f"{np.median(values):{form}} ({max(values):{form}})" if values else "–"


def table_of(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> tuple[list[str], list[list[str]]]:
    """Header and rows, one for each way."""
    header = [
        "tool; library", "effect and joint right", "or a rival", "right one among the claims", "joint right", "false alarms without effects",
        "claims beyond, median (most)", "error, median (largest)", "error without effects", "time [s]",
    ]  # fmt: skip
    rows = []
    for way, entries in found.items():
        there, clean = [e for e in entries if "first" in e], [e for e in entries if "alarm" in e]
        rows.append([
            way, share(there, "first"), share(there, "first_or_rival"), share(there, "among"), share(there, "joint"),
            share(clean, "alarm"), middle(there, "beyond", ".0f"), middle(there, "error", ".2f"), middle(clean, "error", ".2f"),
            middle(entries, "seconds", ".1f"),
        ])  # fmt: skip
    return header, rows
