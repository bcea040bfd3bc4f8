"""The best motions for given springs. Chains of phases share nothing but the springs, so each is searched alone: every phase where the
arm rests in between, and both together where it moves on. A chain has few local optima, and IPOPT ends in one of them within some
hundredths of a second."""

import uuid
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
from msgspec import Struct

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import SOLVED, Optimum, distinct
from rrr_oc.codesign.search.proposals import SearchOptions, phase_guess, sobol_points
from rrr_oc.codesign.search.swings import with_other_swings
from rrr_oc.optimal_control.problem import Guess
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solution, Solver
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.parallel import once_per_process, ordered

COARSE, FINE = 0, 1  # meshes
VIAS = (1, 2)  # points of the proposed paths, in turn: one makes a swing out and back, two make finer ones
STRETCHES = (0.85, 0.92, 1.08, 1.15)  # [1] factors on a duration that a hop tries; with steps twice as large it skips optima
LEADING = (4, 2)  # motions from which hops start, on each mesh; doubled, twice as many hops find a little more
FOLLOWED = 12  # motions of a chain that are followed to the fine mesh, since the coarse one misjudges long ones; doubled, slower and surer
HOPS = 3  # rounds of hops at most; doubled, the search takes longer where every one finds a better motion
LEAST_GAIN = 1e-4  # [1] relative decrease of the cost below which a round of hops is the last one
AT_ONCE = 4  # solves of one call; doubled, fewer calls, which are shared out less evenly
Motions = list[list[Optimum]]  # distinct local optima of each chain of phases, cheapest first


class ChainSolver:
    """Solves each chain of phases alone with fixed springs, on the coarse mesh and on the fine one.

    Attributes:
        solvers: For each chain, that of each mesh.
        data: The problem's data for each mesh: the springs are wide on the coarse one.
    """

    def __init__(self, design: CoDesign, options: SearchOptions) -> None:
        meshes = ((options.coarse, Options(tolerance=1e-6, iterations=100)), (options.fine, Options(barrier=1e-6)))
        self.solvers = []
        for chain in design.problem.chains:
            alone, method = design.problem.alone(chain), _scheme(options)
            transcriptions = [Transcription(alone, method, uniform_mesh(alone, n), compiled=True) for n, _ in meshes]
            self.solvers.append([Solver(t, settings) for t, (_, settings) in zip(transcriptions, meshes, strict=True)])
        self.data = [design.data(width) for width in (options.width, options.widths[-1])]

    def solve(self, mesh: int, chain: int, parameters: np.ndarray, starts: Sequence[np.ndarray]) -> list[Solution | None]:
        """The optima to which some starts lead, without multipliers; None where IPOPT finds none."""
        solver, data = self.solvers[chain][mesh], self.data[mesh]
        found = [solver.solve(w, data, check=False, parameters=(parameters, parameters)) for w in starts]
        return [self.solution(mesh, chain, s.cost, s.w) if s.status == SOLVED else None for s in found]

    def solution(self, mesh: int, chain: int, cost: float, w: np.ndarray) -> Solution:
        """An optimum without multipliers, of its cost and scaled variables."""
        return Solution.bare(self.solvers[chain][mesh].transcription, w, cost)


class Covered(Struct, frozen=True, forbid_unknown_fields=True):
    """What the search for motions of held springs has solved.

    Attributes:
        springs: Number of different springs for which motions were solved.
        motions: Number of motions, each of one phase, or of both where the arm does not rest in between.
        swings: How many of these began from another motion with a swing more or less.
    """

    springs: int = 0
    motions: int = 0
    swings: int = 0


class MotionSearch:
    """The search for the motions of a design's chains of phases.

    Attributes:
        covered: What has been solved.
    """

    def __init__(self, design: CoDesign, options: SearchOptions) -> None:
        self.covered, self._springs = Covered(), set[bytes]()
        self.design, self.options, self.key = design, options, uuid.uuid4().hex
        self.solver = ChainSolver(design, options)  # for its transcriptions; worker processes have one of their own

    def join(self, others: Iterable["MotionSearch"]) -> None:
        """Count what other searches have solved as this one's."""
        for other in others:
            self._springs |= other._springs
            one, more = self.covered, other.covered
            self.covered = Covered(len(self._springs), one.motions + more.motions, one.swings + more.swings)

    def best(self, parameters: np.ndarray, skip: int, known: Motions | None = None) -> Motions:
        """The motions of each chain with the springs of `parameters` (np,), on the fine mesh.

        Proposed motions are solved on the coarse mesh, then hops over the durations of the best ones, as long as these lower a
        chain's cost. The best are followed to the fine mesh, and hop there, too.

        Args:
            skip: Number of proposed motions that earlier calls have used.
            known: Result of an earlier call, maybe with other springs, whose motions are solved again.
        """
        coarse = self._hopped(COARSE, parameters, self.proposed(parameters, self.options.motions, skip))
        transcriptions = [solvers[FINE].transcription for solvers in self.solver.solvers]
        starts = [
            [t.pack(o.solution.guess()) for o in (*some[:FOLLOWED], *others[:FOLLOWED])]
            for t, some, others in zip(transcriptions, coarse, known or [[] for _ in coarse], strict=True)
        ]
        return self._hopped(FINE, parameters, self._solved(FINE, parameters, starts))

    def proposed(self, parameters: np.ndarray, count: int, skip: int = 0, known: Sequence[Solution] = ()) -> Motions:
        """The motions of each chain on the coarse mesh to which `count` proposed ones lead, the first `skip` left out, and those of
        known solutions, which may have other springs."""
        starts = [
            self._starts(i, parameters, count, skip) + [self._packed(i, s) for s in known]
            for i in range(len(self.solver.solvers))
        ]
        return self._solved(COARSE, parameters, starts)

    def with_other_swings(self, guess: Guess) -> Motions:
        """The motions of each chain on the fine mesh with a guess's springs: its own, and those with a swing more or less."""
        parameters, task, starts = guess.parameters, self.design.task, []
        for chain, solvers in zip(self.design.problem.chains, self.solver.solvers, strict=True):
            own = tuple(guess.phases[i] for i in chain)
            others = [
                (*own[:k], other, *own[k + 1 :])
                for k, phase in enumerate(own)
                for other in with_other_swings(phase, self.design.orders, task.duration)
            ]
            starts.append([solvers[FINE].transcription.pack(Guess(some, parameters)) for some in (own, *others)])
        swings = self.covered.swings + sum(len(some) - 1 for some in starts)
        self.covered = msgspec.structs.replace(self.covered, swings=swings)
        return self._solved(FINE, parameters, starts)

    def _packed(self, chain: int, solution: Solution) -> np.ndarray:
        """Scaled variables of a solution's motion of one chain on the coarse mesh."""
        guess = solution.guess()
        phases = tuple(guess.phases[i] for i in self.design.problem.chains[chain])
        return self.solver.solvers[chain][COARSE].transcription.pack(Guess(phases, guess.parameters))

    def _starts(self, chain: int, parameters: np.ndarray, count: int, skip: int) -> list[np.ndarray]:
        """Scaled variables of proposed motions on the coarse mesh."""
        phases, count, starts = self.design.problem.chains[chain], -(-count // len(VIAS)), []
        for via in VIAS:
            size = 2 + len(self.design.task.moving) * via
            for vector in sobol_points(size * len(phases), skip + count, self.options.seed)[skip:]:
                own = zip(phases, np.split(vector, len(phases)), strict=True)
                guess = Guess(tuple(phase_guess(self.design.task, i, part) for i, part in own), parameters)
                starts.append(self.solver.solvers[chain][COARSE].transcription.pack(self.design.lifted(guess, phases)))
        return starts

    def _hopped(self, mesh: int, parameters: np.ndarray, motions: Motions) -> Motions:
        """Motions, with those to which hops over the durations of the best ones of each chain lead."""
        hopping = [True] * len(motions)
        for _ in range(HOPS):
            starts = [
                [w for o in some[: LEADING[mesh]] for w in self._stretched(o)] if hops else []
                for some, hops in zip(motions, hopping, strict=True)
            ]
            new = self._solved(mesh, parameters, starts)
            both = [distinct([*some, *more]) for some, more in zip(motions, new, strict=True)]
            pairs = zip(motions, both, strict=True)
            hopping = [bool(new) and (not old or new[0].cost < old[0].cost * (1 - LEAST_GAIN)) for old, new in pairs]
            motions = both
            if not any(hopping):
                break
        return motions

    def _stretched(self, motion: Optimum) -> list[np.ndarray]:
        """Scaled variables of a motion with one phase run through in other durations."""
        (shortest, longest), starts = self.design.task.duration, []
        for block in motion.solution.transcription.blocks:
            for factor in STRETCHES:
                w = motion.solution.w.copy()
                w[block.duration] = np.clip(factor * w[block.duration], shortest, longest)
                starts.append(w)
        return starts

    def _solved(self, mesh: int, parameters: np.ndarray, starts: Sequence[Sequence[np.ndarray]]) -> Motions:
        """The distinct motions to which starts of each chain lead, cheapest first."""
        calls = [(i, some[k : k + AT_ONCE]) for i, some in enumerate(starts) for k in range(0, len(some), AT_ONCE)]
        shared = self.key, self.design, self.options
        self._springs.add(parameters.tobytes())
        motions = self.covered.motions + sum(map(len, starts))
        self.covered = msgspec.structs.replace(self.covered, springs=len(self._springs), motions=motions)
        optima: Motions = [[] for _ in starts]
        for (i, _), found in zip(
            calls, ordered(_solve, [(*shared, (mesh, i), parameters, some) for i, some in calls]), strict=True
        ):
            optima[i] += [Optimum(self.solver.solution(mesh, i, *one), []) for one in found if one is not None]
        return [distinct(some) for some in optima]


def _solve(
    key: str,
    design: CoDesign,
    options: SearchOptions,
    at: tuple[int, int],
    parameters: np.ndarray,
    starts: Sequence[np.ndarray],
) -> list[tuple[float, np.ndarray] | None]:
    """Cost and scaled variables of what starts on a mesh of a chain lead to, `at` = (mesh, chain)."""
    solver = once_per_process(key, lambda: ChainSolver(design, options))
    return [None if s is None else (s.cost, s.w) for s in solver.solve(*at, parameters, starts)]


def _scheme(options: SearchOptions):
    return scheme(options.scheme, options.stages)


def combined(motions: Motions, parameters: np.ndarray, next_best: int = 2) -> list[Guess]:
    """Motions put together: the best of every chain, then those with one of the next best of one chain; none where a chain has no
    motion."""
    if not all(motions):
        return []
    choices = [[0] * len(motions)]
    for rank in range(1, next_best + 1):
        choices += [[rank * (i == j) for i in range(len(motions))] for j, some in enumerate(motions) if rank < len(some)]
    chosen = [[some[i].solution.guess() for some, i in zip(motions, choice, strict=True)] for choice in choices]
    return [Guess(tuple(phase for guess in guesses for phase in guess.phases), parameters) for guesses in chosen]
