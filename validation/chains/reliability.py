"""How often are claims right, by what is known of them? The coefficients of `rrr_oc/data/reliability.json`, and how they hold elsewhere.

    python -m validation.chains.make --out cases --seed 2 --count 156
    python -m validation.chains.diagnoses cases --out results/chains
    python -m validation.chains.reliability cases --out results/chains --write

An effect is right if it is there or equal to what is, by the plant's own columns, or if the chain of measurement has it; a torque that
is described, if its joint lacks one of which its variables explain half. A table says how often claims are right of which a regression
on all other families says how probable they are.
"""

import argparse
import itertools
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from rrr_oc.diagnosis.claims.reliability import NAMES, features, probability_of
from rrr_oc.storage import write_json
from validation.chains.make import cases_of
from validation.chains.scoring import Sealed, variables

ROOT = Path(__file__).resolve().parents[2]
PENALTY = 1.0  # precision of the coefficients of quantities of size 1, beside that of claims as a whole
SIGNS = (0, 1, 1, -1, -1, -1, 1, -1)  # of the coefficients; the first may have any
LEVELS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.97, 1.0)
Claims = list[tuple[str, np.ndarray, bool]]  # family, quantities, whether it is right


def claims(cases: Path, out: Path) -> dict[str, Claims]:
    """The claims of all cases that were diagnosed, by kind."""
    result: dict[str, Claims] = {"law": [], "dependence": []}
    for folder in cases_of(cases):
        if not (found := diagnosis_of(folder, out)):
            continue
        truth = json.loads((folder / "sealed" / "truth.json").read_text())
        for kind, x, right in _of_case(found, Sealed.read(folder / "sealed", truth)):
            result[kind].append((folder.name.split("-")[0], x, right))
    return result


def diagnosis_of(folder: Path, out: Path) -> dict[str, Any]:
    """What was said of a case; nothing where it was not diagnosed."""
    file = out / "diagnoses" / f"{folder.name}.json"
    return json.loads(file.read_text()).get("diagnosis", {}) if file.exists() else {}


def _of_case(found: dict[str, Any], sealed: Sealed) -> Iterator[tuple[str, np.ndarray, bool]]:
    laws = [e for e in found["effects"] if e["effect"] != "time_delay"]
    on = Counter(e["lowers_error"]["joint"] for e in (*laws, *found["unexplained"]))
    for e in laws:
        yield "law", _quantities(e, found, on), any(sealed.there(x) for x in (e, *e["rivals"]))
    for u in found["unexplained"]:
        right = any(sealed.depends(j, variables(u, sealed)) for j in sealed.at(u) if j in sealed.hidden)
        yield "dependence", _quantities(u, found, on), right


def _quantities(entry: dict[str, Any], found: dict[str, Any], on: Counter[str]) -> np.ndarray:
    """What a file says of a claim, as of `NAMES`, (8,); `on` has the number of findings by joint."""
    size = entry["lowers_error"]
    lows = [x["interval"][0] for x in (size, size["innovations"]) if x is not None and x["interval"] is not None]
    of_law, joint = (entry.get("reaches"), len(entry.get("rivals", ()))), size["joint"]
    parts = {p["part"]: p["share"] for p in found["anatomy"][joint]}
    return features(entry["log_odds"], lows, (size["of_torque"], on[joint] - 1), parts, *of_law)


def regression(some: Claims) -> np.ndarray:
    """Coefficients of the penalised logistic regression, of `NAMES`, (8,).

    What speaks for a claim never speaks against it (`SIGNS`). One claim more that is right, and one that is wrong, are like the mean of
    all: of claims that are all right so far, the next may be wrong (Laplace).
    """
    x, y = np.array([x for _, x, _ in some]), np.array([right for *_, right in some], float)
    x, y = np.vstack([x, x.mean(axis=0), x.mean(axis=0)]), np.append(y, [1.0, 0.0])
    size = np.maximum(x.std(axis=0), 1e-9)
    size[0] = np.inf  # the constant is not penalised

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z = x @ w
        weights = PENALTY * np.where(np.isfinite(size), size, 0.0) ** 2
        return float(np.sum(np.logaddexp(0, z) - y * z) + 0.5 * weights @ w**2), x.T @ (expit(z) - y) + weights * w

    bounds = [(0.0 if sign > 0 else None, 0.0 if sign < 0 else None) for sign in SIGNS]
    return minimize(loss, np.zeros(x.shape[1]), jac=True, bounds=bounds).x


def elsewhere(some: Claims) -> list[tuple[str, float, bool]]:
    """Family, probability by a regression on all other families, and whether it is right, of each claim."""
    result = []
    for family in sorted({one for one, *_ in some}):
        w = regression([c for c in some if c[0] != family])
        result += [(family, probability_of(x, w), right) for name, x, right in some if name == family]
    return result


def table(every: list[tuple[str, float, bool]]) -> str:
    """Shares of right claims by their probability."""
    lines = ["probability | claims | mean | right", "--- | --- | --- | ---"]
    for low, high in itertools.pairwise(LEVELS):
        inside = [(p, right) for _, p, right in every if low <= p < high]
        if inside:
            p, right = (np.mean(x) for x in zip(*inside, strict=True))
            lines.append(f"{low} to {high} | {len(inside)} | {p:.3f} | {right:.3f}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="the folder that `diagnoses` wrote")
    parser.add_argument("--write", action="store_true", help="the file of the package")
    options = parser.parse_args()
    every = claims(options.cases, options.out)
    found = {}
    for kind, some in every.items():
        found[kind] = regression(some)
        print(f"\n{kind}: {len(some)} claims, {sum(right for *_, right in some)} right")
        print(", ".join(f"{name} {w:.2f}" for name, w in zip(NAMES, found[kind], strict=True)))
        print(table(elsewhere(some)))
    if options.write:
        names = sorted(folder.name for folder in cases_of(options.cases) if diagnosis_of(folder, options.out))
        content = {kind: [round(float(x), 4) for x in w] for kind, w in found.items()}
        content |= {"claims": [len(some) for some in every.values()]}
        content |= {"cases": f"{len(names)} cases, {names[0]} to {names[-1]}"}
        write_json(ROOT / "rrr_oc" / "data" / "reliability.json", content)


if __name__ == "__main__":
    main()
