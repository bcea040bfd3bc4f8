"""The paper's optimiser: CMA-ES on the paper's parametrisation, in MuJoCo or in the analytic model.

Population 64, initial standard deviation 0.15 on variables normalised by the region of initial means (`encoding.Encoding.region`), a
random initial mean there, at most 1000 generations ("The evolution strategy", "Elastic element and trajectory co-optimization"). The
costs of all candidates are saved every few generations. From them and the seed an interrupted trial goes through its generations again
without evaluating them, and continues to the same result.
"""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cma
import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.errors import UserError
from studies.paper.encoding import VIA, Analytic, Encoding, Scores
from studies.paper.engine_population import STEPS, Engine
from studies.paper.run_store import Run

Where = Literal["engine", "analytic"]
FINE_NODES, FINE_STEPS = 40, 960  # nodes an interval and engine steps a phase with which the best candidate is evaluated


@dataclass(frozen=True)
class Protocol:
    """Settings of a trial.

    Attributes:
        model: Where candidates are evaluated: "engine" is MuJoCo, "analytic" the symbolic model.
        generations: Largest number of generations; pycma's own criteria of convergence may end a trial before.
        population: Candidates a generation.
        sigma: Initial standard deviation, relative to the extent of the region of initial means.
        via: Path points per phase and joint.
        steps: Steps of the engine per phase.
        every: Generations between two checkpoints.
    """

    model: Where = "engine"
    generations: int = 1000
    population: int = 64
    sigma: float = 0.15
    via: int = VIA
    steps: int = STEPS
    every: int = 20

    def __post_init__(self) -> None:
        if self.model not in get_args(Where):
            raise UserError(f"evolution knows the models {', '.join(get_args(Where))}; got {self.model!r}")
        if min(self.generations, self.every) < 1 or self.population < 4 or not 0 < self.sigma < np.inf:
            raise UserError(
                "evolution needs at least 1 generation, checkpoints at least 1 generation apart, a population of at least 4 and a "
                f"sigma above 0; got {self.generations}, {self.every}, {self.population} and {self.sigma:g}"
            )

    def objective(self, encoding: Encoding) -> "Analytic | Engine":
        """The function that is minimised."""
        return Engine(encoding, self.steps) if self.model == "engine" else Analytic(encoding)


def evolve(
    design: CoDesign, protocol: Protocol, seed: int, folder: Path, labels: Mapping[str, Any], start: np.ndarray | None = None
) -> dict[str, Any]:
    """One trial in a run's folder: run, continued from its checkpoint, or read if it has ended.

    Args:
        seed: Seed of the initial mean and of everything else that is random.
        labels: Description of the run, kept with it.
        start: The initial mean, (size of the encoding,); default uniform in the encoding's region.

    Returns:
        "x", "cost", "E1", "excess" of the best candidate by the trial's own objective; "analytic" and "engine", E1 of that candidate
        on a fine quadrature and with small steps, and its excess "limits_exceeded"; "parameters", "hardware", "durations";
        "evaluations", "generations", "stopped" (pycma's criterion, or "generations"), "core_s" and "wall_s". The run's arrays hold
        for each generation `evaluations`, `core_s` since the start [s], `best` so far and `median` of the generation.
    """
    encoding = Encoding(design, protocol.via)
    asked = {**labels, **asdict(protocol), "seed": seed, "start": None if start is None else start.tolist()}
    run = Run(folder, asked)
    if (found := run.found) is not None:
        return found
    objective = protocol.objective(encoding)
    state = _begun(encoding, protocol, seed, start, objective)
    if (saved := run.saved()) is not None:
        state = state.replayed(saved) or _begun(encoding, protocol, seed, start, objective)
    while not state.ended(protocol):
        state.step(objective)
        if state.strategy.countiter % protocol.every == 0:
            run.save(state.packed())
    found = _judged(encoding, state, protocol)
    run.finish(found, state.history())
    return found


@dataclass
class _State:
    """A trial between two generations. Times add up over all parts of an interrupted trial."""

    strategy: Any
    costs: list[np.ndarray]  # of the candidates of each generation
    rows: list[tuple[float, float, float, float]]  # evaluations, core seconds, best so far, median
    best: tuple[np.ndarray, float, float, float]  # x, cost, E1, excess
    wall: float

    def ended(self, protocol: Protocol) -> bool:
        return self.strategy.countiter >= protocol.generations or bool(self.strategy.stop())

    def step(self, objective) -> None:
        cores, wall = time.process_time(), time.perf_counter()
        x = np.array(self.strategy.ask())
        scores: Scores = objective(x)
        self.strategy.tell(list(x), scores.cost.tolist())
        self.costs.append(scores.cost)
        k = int(np.argmin(scores.cost))
        if scores.cost[k] < self.best[1]:
            self.best = x[k], float(scores.cost[k]), float(scores.E1[k]), float(scores.excess[k])
        before = self.rows[-1][1] if self.rows else 0.0
        self.wall += time.perf_counter() - wall
        spent = before + time.process_time() - cores
        self.rows.append((self.strategy.countevals, spent, self.best[1], float(np.median(scores.cost))))

    def packed(self) -> dict[str, np.ndarray]:
        """All that a trial cannot compute again, as plain numbers."""
        x, *scores = self.best
        arrays = {
            "costs": self.costs,
            "rows": self.rows,
            "best": x,
            "scores": scores,
            "mean": self.strategy.mean,
            "wall": self.wall,
        }
        return {name: np.array(values, float) for name, values in arrays.items()}

    def replayed(self, saved: Mapping[str, np.ndarray]) -> "_State | None":
        """A trial that has just begun, taken to where `packed` was saved; None where the strategy now goes another way, as of another
        version. Changes this one."""
        count, mean = len(saved.get("costs", ())), self.strategy.mean
        shapes = {
            "costs": (count, self.strategy.popsize),
            "rows": (count, 4),
            "best": mean.shape,
            "scores": (3,),
            "mean": mean.shape,
            "wall": (),
        }
        if any(name not in saved or saved[name].shape != shape for name, shape in shapes.items()):
            return None
        for costs in saved["costs"]:
            self.strategy.tell(list(np.array(self.strategy.ask())), costs.tolist())
        if not np.array_equal(self.strategy.mean, saved["mean"]):
            return None
        cost, E1, excess = map(float, saved["scores"])
        best = saved["best"], cost, E1, excess
        return _State(self.strategy, [*saved["costs"]], [*map(tuple, saved["rows"].tolist())], best, float(saved["wall"]))

    def history(self) -> dict[str, np.ndarray]:
        columns = np.array(self.rows).T
        return dict(zip(("evaluations", "core_s", "best", "median"), columns, strict=True))


class _Normal:
    """Standard normal numbers for pycma, from a generator of the trial's own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, *shape: int) -> np.ndarray:
        return self.rng.standard_normal(shape)


def _begun(encoding: Encoding, protocol: Protocol, seed: int, start: np.ndarray | None, objective) -> _State:
    rng = np.random.default_rng(seed)
    low, high = encoding.region
    mean = low + (high - low) * rng.random(encoding.size) if start is None else np.asarray(start, float)
    if mean.shape != (encoding.size,):
        raise UserError(f"the start has shape {mean.shape}, and a candidate of this design has {encoding.size} variables")
    options: dict[str, Any] = {
        "bounds": [0, 1],
        "popsize": protocol.population,
        "verbose": -9,
        "randn": _Normal(rng),
        "seed": np.nan,
    }
    options["CMA_stds"] = high - low
    strategy = cma.CMAEvolutionStrategy(mean, protocol.sigma, options)
    if start is None:
        return _State(strategy, [], [], (mean, np.inf, np.inf, np.inf), 0.0)
    scores = objective(mean[None])
    return _State(strategy, [], [], (mean, float(scores.cost[0]), float(scores.E1[0]), float(scores.excess[0])), 0.0)


def _judged(encoding: Encoding, state: _State, protocol: Protocol) -> dict[str, Any]:
    x, cost, E1, excess = state.best
    candidate = encoding.decode(x[None])
    exact, engine = Analytic(encoding, FINE_NODES).score(candidate), Engine(encoding, FINE_STEPS)(x[None])
    parameters, reasons = candidate.theta[:, 0], list(state.strategy.stop())
    return {
        "x": x.tolist(),
        "cost": cost,
        "E1": E1,
        "excess": excess,
        "analytic": float(exact.E1[0]),
        "engine": float(engine.E1[0]),
        "limits_exceeded": float(exact.excess[0]),
        "parameters": parameters.tolist(),
        "hardware": {k: float(v) for k, v in encoding.design.hardware(parameters).items()},
        "durations": candidate.durations[:, 0].tolist(),
        "evaluations": int(state.strategy.countevals),
        "generations": int(state.strategy.countiter),
        "stopped": ", ".join(map(str, reasons)) or "generations",
        "core_s": state.rows[-1][1],
        "wall_s": state.wall,
    }
