"""Starting points of a search, and the optima on a coarse mesh to which IPOPT leads from them."""

import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import ACCEPTED, Optimum, Solvable, distinct, transcribed
from rrr_oc.codesign.search.proposals import LAYERS, SearchOptions, cma_strategy, dimensions, proposed_guess, sobol_points
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.parallel import once_per_process, unordered

# Initial barrier parameters of the starts from Sobol points, in turn; None is IPOPT's adaptive strategy, which all other starts have. A
# large one leads every start to the middle of all bounds first, and from there to one good optimum or few; more of them, and the
# optima that are not on that way are missed.
BARRIERS = (1.0, None, None, None)
_Design = TypeVar("_Design", bound=Solvable)
_Settings = tuple[Solvable, SearchOptions, Sequence[float | None], int]
_Call = tuple[str, _Settings, str, np.ndarray, Sequence[float | None]]


@dataclass(frozen=True)
class Start:
    """A starting point and the optimum that IPOPT found from it.

    Attributes:
        layer: Its source: of `LAYERS`, "known" for what was known before, or "improved" for what is made of other optima; of several
            tasks that share the springs "alone" for the springs of one of them.
        proposed: Cost of the starting point itself; its motion may exceed limits.
        polished: Cost after IPOPT, on the coarse mesh; infinite where IPOPT found no optimum.
        message: IPOPT's status.
        seconds: Wall time of the polish [s].
        w: Scaled variables of the optimum on the coarse mesh; empty where there is none.
    """

    layer: str
    proposed: float
    polished: float
    message: str
    seconds: float
    w: np.ndarray


def layers(starts: Sequence[Start]) -> dict[str, dict[str, float]]:
    """By layer: number of starts and of failures, best and median cost, best cost before IPOPT, wall time [s]."""
    rows = {}
    for layer in dict.fromkeys(s.layer for s in starts):
        own = [s for s in starts if s.layer == layer]
        costs = [s.polished for s in own if np.isfinite(s.polished)]
        rows[layer] = {
            "starts": len(own),
            "failed": len(own) - len(costs),
            "best": min(costs, default=float("inf")),
            "median": float(np.median(costs or [np.inf])),
            "best_proposal": min(s.proposed for s in own),
            "seconds": float(sum(s.seconds for s in own)),
        }
    return rows


class Polisher(Generic[_Design]):
    """Solves a problem, of one task or of several, on the coarse mesh with some initial barrier parameters, in each process with
    solvers of its own.

    Attributes:
        key: Of its solvers in a process.
    """

    def __init__(
        self,
        design: _Design,
        options: SearchOptions,
        barriers: Sequence[float | None] = (None, *BARRIERS),
        iterations: int = 200,
    ) -> None:
        self.design, self.options, self.key = design, options, uuid.uuid4().hex
        self._settings, settings = (design, options, barriers, iterations), Options(tolerance=1e-6, iterations=iterations)
        self.transcription = transcribed(design, options, options.coarse)
        self.solvers = {b: Solver(self.transcription, replace(settings, barrier=b)) for b in barriers}
        self.data, self.unit = design.data(options.width), design.problem.cost_scale

    def call(self, w: np.ndarray | Guess, layer: str = "improved", barriers: Sequence[float | None] = (None,)) -> _Call:
        """The arguments of a polish of scaled variables or of a guess, that have a layer as their source, with each of some initial
        barrier parameters; None is IPOPT's adaptive one."""
        return self.key, self._settings, layer, self.transcription.pack(w) if isinstance(w, Guess) else w, barriers

    def proposal(self: "Polisher[CoDesign]", layer: str, vector: np.ndarray, index: int) -> _Call:
        """As `call`, for the guess that a vector in [0, 1] stands for, of the index that it has in its layer."""
        barrier = BARRIERS[index % len(BARRIERS)] if layer == LAYERS[0] else None
        return self.call(proposed_guess(self.design, vector, self.options.via), layer, (barrier,))

    def started(self, layer: str, w: np.ndarray, barriers: Sequence[float | None]) -> Start:
        """The best optimum from scaled variables, solved once with each of some of the barrier parameters."""
        proposed = float(self.transcription.functions["nlp"](w, self.data)[0]) * self.unit
        tries = [self.solvers[b].solve(w, self.data, check=False) for b in barriers]
        seconds, found = sum(s.seconds for s in tries), [s for s in tries if s.status in ACCEPTED]
        best = min(found, key=lambda s: s.cost, default=None)
        if best is None:
            return Start(layer, proposed, float("inf"), tries[0].status, seconds, np.empty(0))
        return Start(layer, proposed, best.cost, best.status, seconds, best.w)

    def solution(self, start: Start) -> Solution:
        """The optimum on the coarse mesh that a start led to, without multipliers."""
        return Solution.bare(self.transcription, start.w, start.polished)

    def optima(self, starts: Sequence[Start]) -> list[Optimum]:
        """The distinct optima to which starts led, cheapest first, and how many of the Sobol points led to each."""
        found = sorted((s for s in starts if s.w.size), key=lambda s: s.polished)
        return distinct(Optimum(self.solution(s), [], int(s.layer == LAYERS[0])) for s in found)


def polish(key: str, settings: _Settings, layer: str, w: np.ndarray, barriers: Sequence[float | None]) -> Start:
    """What scaled variables lead to, as `Polisher.call` has them."""
    return once_per_process(key, lambda: Polisher(*settings)).started(layer, w, barriers)


def all_starts(polisher: Polisher[CoDesign]) -> Iterator[Start]:
    """All starts: first Sobol points, then CMA-ES, which sees the costs after IPOPT and is restarted where it converges."""
    options, size = polisher.options, dimensions(polisher.design, polisher.options.via)
    half = (options.starts + 1) // 2 if options.layers == LAYERS else options.starts if LAYERS[0] in options.layers else 0
    yield from sobol_starts(polisher, half)
    left = options.starts - half
    while left > 0:
        strategy = cma_strategy(size, options, left)
        while left > 0 and not strategy.stop():
            vectors = strategy.ask()
            costs = np.full(len(vectors), np.inf)
            calls = [(i, *polisher.proposal("cma-es", vector, i)) for i, vector in enumerate(vectors[:left])]
            for i, start in unordered(_numbered, calls):
                costs[i] = start.polished
                yield start
            left -= len(vectors)
            worst = costs[np.isfinite(costs)].max(initial=1e6)
            strategy.tell(vectors, np.where(np.isfinite(costs), costs, 2 * worst).tolist())


def sobol_starts(polisher: Polisher[CoDesign], count: int) -> Iterator[Start]:
    """The starts from so many Sobol points, in the order of their polishes' ends."""
    points = sobol_points(dimensions(polisher.design, polisher.options.via), count, polisher.options.seed)
    yield from unordered(polish, [polisher.proposal(LAYERS[0], point, i) for i, point in enumerate(points)])


def _numbered(number: int, *call: Any) -> tuple[int, Start]:
    return number, polish(*call)
