"""How do peers solve optimal control problems whose optimum is known? The same statement, guess and meshes for all.

    python validation/peers/optimal_control.py --out results/peers

Problems: the Rayleigh oscillator and the brachistochrone of `validation/optimal_control.py`, whose optima are known from an indirect
method and in closed form, and the paper's task with stiff actuation, two phases of free duration, whose reference is the project's
own solution on a mesh refined to 1e-9. Each tool takes the first of the meshes whose cost is within `CLOSE` of the known one; the
row is of that solve, or of the closest that converged. Equations reach dymos, CasADi and the project as the same CasADi functions
with exact derivatives, opty as SymPy expressions of the same law.

Set-up and solve are processor times, those of compilers that were started included. A tool's row is in
OUT/optimal_control/<problem> <tool>.json when it is whole.
"""

import argparse
import os
import resource
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("OPENMDAO_REPORTS", "0")  # pages that dymos writes beside the solution
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

# pyright: reportMissingImports=false
# (peers are in environments of their own)

import casadi as ca  # noqa: E402
import numpy as np  # noqa: E402

from rrr_oc.codesign.design_problem import CoDesign  # noqa: E402
from rrr_oc.codesign.task import load_task  # noqa: E402
from rrr_oc.optimal_control.problem import Guess, Phase, PhaseGuess, Problem  # noqa: E402
from rrr_oc.optimal_control.refinement import Refinement, refine  # noqa: E402
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh  # noqa: E402
from rrr_oc.optimal_control.solver import Options, Solver, solve  # noqa: E402
from rrr_oc.optimal_control.transcription import Transcription  # noqa: E402
from rrr_oc.storage import write_json  # noqa: E402
from validation.optimal_control import brachistochrone, rayleigh  # noqa: E402

CLOSE = 1e-5  # relative error of the cost
MESHES = (8, 16, 32, 64, 128, 256, 512, 1024)  # intervals of a phase
LONGEST = 10.0  # processor time of a solve [s], without its set-up, beyond which a tool takes no finer mesh
FIRST = 2.0  # [s], duration of the stiff task's phases to begin with


@dataclass(frozen=True)
class Known:
    """A problem of phases that share nothing, and its known cost.

    Attributes:
        name, title: Key and words.
        problem, guess: As the project states it.
        cost: The known cost.
        laws: For each phase sympy expressions: (states, controls) -> (rates, cost rate).
        least_time: Whether the cost is the duration.
    """

    name: str
    title: str
    problem: Problem
    guess: Guess
    cost: float
    laws: tuple[Callable[[Sequence[Any], Sequence[Any]], tuple[list[Any], Any]], ...]
    least_time: bool = False

    @cached_property
    def functions(self) -> tuple[ca.Function, ...]:
        """(x, u) -> (dx/dt, cost rate) of each phase, with the problem's data in it."""
        found = []
        for phase in self.problem.phases:
            x, u = ca.SX.sym("x", len(phase.x)), ca.SX.sym("u", len(phase.u))
            data = self.problem.data if phase.data is None else self.problem.data[phase.data]
            found.append(ca.Function("law", [x, u], list(phase.rates.call([x, u, ca.SX(0, 1), data])[:2])))
        return tuple(found)


@dataclass(frozen=True)
class Solved:
    """One solve: the cost found, whether the tool says that it converged, its iterations, processor times [s]."""

    cost: float
    converged: bool
    iterations: int | None
    set_up: float
    solving: float


def processor_time() -> float:
    """Of this process and those that it waited for [s]."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(x.ru_utime + x.ru_stime for x in both)


# --- the problems ---


def problems(only: str | None = None) -> list[Known]:
    """Rayleigh, brachistochrone, and the stiff task, or only one of them."""
    made = {"rayleigh": of_rayleigh, "brachistochrone": of_brachistochrone, "stiff": stiff}
    return [make() for name, make in made.items() if only in (None, name)]


def of_rayleigh() -> Known:
    """The oscillator of `validation/optimal_control.py`."""
    import sympy as sm

    def law(x, u):
        return [x[1], -x[0] + x[1] * (sm.Float(1.4) - sm.Float(0.14) * x[1] ** 2) + 4 * u[0]], u[0] ** 2 + x[0] ** 2

    case = rayleigh()
    return Known("rayleigh", "Rayleigh oscillator", case.problem, case.guess, float(case.cost), (law,))


def of_brachistochrone() -> Known:
    """The brachistochrone of `validation/optimal_control.py`."""
    import sympy as sm

    def law(x, u):
        return [x[2] * sm.sin(u[0]), x[2] * sm.cos(u[0]), sm.Float(9.81) * sm.cos(u[0])], sm.Integer(1)

    case = brachistochrone()
    return Known("brachistochrone", "Brachistochrone", case.problem, case.guess, float(case.cost), (law,), least_time=True)


def stiff() -> Known:
    """The paper's task with stiff actuation, from straight lines; the reference on a mesh refined to 1e-9."""
    problem = CoDesign(load_task("paper"), ()).problem
    guess = Guess(tuple(_line(phase) for phase in problem.phases), np.zeros(0))
    options = Options(tolerance=1e-11)
    best, _ = refine(solve(problem, guess, 16, scheme("gauss", 3), options), Refinement(tolerance=1e-9), options)
    return Known("stiff", "The paper's task, stiff", problem, guess, best.cost, tuple(_arm_law(problem, i) for i in range(2)))


def _line(phase: Phase) -> PhaseGuess:
    start, end, nu = phase.start, phase.end, len(phase.u)
    return PhaseGuess(FIRST, lambda s: start[:, None] + (end - start)[:, None] * s, lambda s: np.zeros((nu, len(s))))


def _arm_law(problem: Problem, index: int) -> Callable[[Sequence[Any], Sequence[Any]], tuple[list[Any], Any]]:
    """Torques of two parallel joints in SymPy: the coefficients of their closed form, from the project's torques by least squares."""
    import sympy as sm

    task = load_task("paper")
    torques, payload = CoDesign(task, ()).torques, task.payload if index == 0 else 0.0

    def columns(q, dq, ddq, f):
        one, both = q[0], q[0] + q[1]
        c, s = f.cos(q[1]), f.sin(q[1])
        h = (2 * ddq[0] + ddq[1]) * c - (2 * dq[0] * dq[1] + dq[1] ** 2) * s
        k = (2 * ddq[0] + ddq[1]) * s + (2 * dq[0] * dq[1] + dq[1] ** 2) * c
        gravity = [f.cos(one), f.sin(one), f.cos(both), f.sin(both)]
        upper = [ddq[0], ddq[0] + ddq[1], h, k, *gravity]
        lower = [
            0 * ddq[0],
            ddq[0] + ddq[1],
            ddq[0] * c + dq[0] ** 2 * s,
            ddq[0] * s - dq[0] ** 2 * c,
            0 * one,
            0 * one,
            *gravity[2:],
        ]
        return upper, lower

    rng = np.random.default_rng(0)
    samples = rng.uniform(-1, 1, (40, 3, 2))
    a = np.concatenate([np.array(columns(sample[0], sample[1], sample[2], np)) for sample in samples])
    b = np.concatenate([np.array(torques.call([*sample, payload, [], []])[0]).ravel() for sample in samples])
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    if np.abs(a @ found - b).max() > 1e-9:
        raise RuntimeError("the closed form of the arm's torques misses the project's torques")

    def law(x, u):
        rows = columns(x[:2], x[2:], u, sm)
        return [x[2], x[3], u[0], u[1]], sum(sum(sm.Float(c) * t for c, t in zip(found, row, strict=True)) ** 2 for row in rows)

    return law


# --- the tools ---


def ours(known: Known, intervals: int) -> Solved:
    """The project: Gauss, three stages, uniform mesh."""
    began = processor_time()
    transcription = Transcription(known.problem, scheme("gauss", 3), uniform_mesh(known.problem, intervals))
    solver = Solver(transcription, Options())
    made = processor_time()
    found = solver.solve(known.guess, check=False)
    return Solved(found.cost, found.status == "Solve_Succeeded", found.iterations, made - began, processor_time() - made)


def opti(method: str) -> Callable[[Known, int], Solved]:
    """CasADi's `Opti` with IPOPT's defaults, as written by hand."""

    def run(known: Known, intervals: int) -> Solved:
        began = processor_time()
        model, total = ca.Opti(), ca.MX(0)
        s = np.linspace(0, 1, intervals + 1)
        for phase, guess, law in zip(known.problem.phases, known.guess.phases, known.functions, strict=True):
            total += _by_hand(model, phase, guess, law, s, method)
        model.minimize(total)
        model.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
        made = processor_time()
        try:
            value, converged = float(model.solve().value(total)), True
        except RuntimeError:
            value, converged = float(model.debug.value(total)), False
        return Solved(value, converged, int(model.stats()["iter_count"]), made - began, processor_time() - made)

    return run


def _by_hand(model: Any, phase: Phase, guess: PhaseGuess, law: ca.Function, s: np.ndarray, method: str) -> Any:
    nx, nu, n = len(phase.x), len(phase.u), len(s) - 1
    x, u = model.variable(nx, n + 1), model.variable(nu, n + 1)
    fixed = phase.duration[0] == phase.duration[1]
    T = phase.duration[0] if fixed else model.variable()
    if not fixed:
        model.subject_to(model.bounded(phase.duration[0], T, phase.duration[1]))
        model.set_initial(T, guess.duration)
    model.set_initial(x, guess.states(s))
    model.set_initial(u, guess.controls(s))
    _bound(model, x, phase.x.lower, phase.x.upper)
    _bound(model, u, phase.u.lower, phase.u.upper)
    for at, values in ((0, phase.start), (n, phase.end)):
        for i in np.flatnonzero(np.isfinite(values)).tolist():
            model.subject_to(x[i, at] == values[i])
    h = T / n
    f, g = law.map(n + 1)(x, u)
    first, last = (x[:, :-1], f[:, :-1]), (x[:, 1:], f[:, 1:])
    if method == "trapezoid":
        model.subject_to(ca.vec(last[0] - first[0] - h / 2 * (first[1] + last[1])) == 0)
        return h / 2 * ca.sum2(g[:, :-1] + g[:, 1:])
    middle = model.variable(nu, n)
    model.set_initial(middle, guess.controls((s[:-1] + s[1:]) / 2))
    _bound(model, middle, phase.u.lower, phase.u.upper)
    f_middle, g_middle = law.map(n)((first[0] + last[0]) / 2 + h / 8 * (first[1] - last[1]), middle)
    model.subject_to(ca.vec(last[0] - first[0] - h / 6 * (first[1] + 4 * f_middle + last[1])) == 0)
    return h / 6 * ca.sum2(g[:, :-1] + 4 * g_middle + g[:, 1:])


def _bound(model: Any, variable: Any, lower: np.ndarray, upper: np.ndarray) -> None:
    for i, (a, b) in enumerate(zip(lower, upper, strict=True)):
        if np.isfinite(a) or np.isfinite(b):
            model.subject_to(model.bounded(a, variable[i, :], b))


def dymos(order: int) -> Callable[[Known, int], Solved]:
    """dymos with Gauss–Lobatto segments and SciPy's SLSQP, sparse derivatives by colouring."""

    def run(known: Known, intervals: int) -> Solved:
        parts = [
            _dymos_phase(phase, guess, law, intervals, order, known.least_time)
            for phase, guess, law in zip(known.problem.phases, known.guess.phases, known.functions, strict=True)
        ]
        return summed(parts)

    return run


def summed(parts: Sequence[Solved]) -> Solved:
    """Of phases that were solved one after the other."""
    counts = [p.iterations for p in parts]
    iterations = None if None in counts else sum(c for c in counts if c is not None)
    totals = [float(sum(getattr(p, key) for p in parts)) for key in ("cost", "set_up", "solving")]
    return Solved(totals[0], all(p.converged for p in parts), iterations, *totals[1:])


def _dymos_phase(phase: Phase, guess: PhaseGuess, law: ca.Function, intervals: int, order: int, least_time: bool) -> Solved:
    import dymos as dm
    import openmdao.api as om

    began = processor_time()
    nx, nu = len(phase.x), len(phase.u)
    # dymos makes the component itself, with the number of nodes
    system = _component(om.ExplicitComponent, law, nx, nu)
    made = dm.Phase(ode_class=system, transcription=dm.GaussLobatto(num_segments=intervals, order=order, compressed=True))
    fixed = phase.duration[0] == phase.duration[1]
    made.set_time_options(fix_initial=True, **({"fix_duration": True} if fixed else {"duration_bounds": phase.duration}))
    for i in range(nx):
        bounds = {k: float(v[i]) for k, v in (("lower", phase.x.lower), ("upper", phase.x.upper)) if np.isfinite(v[i])}
        ends = {"fix_initial": True, "fix_final": bool(np.isfinite(phase.end[i]))}
        made.add_state(f"x{i}", rate_source=f"dx{i}", targets=[f"x{i}"], **ends, **bounds)
    if not least_time:
        made.add_state("cost", rate_source="rate", fix_initial=True)
    for i in range(nu):
        bounds = {k: float(v[i]) for k, v in (("lower", phase.u.lower), ("upper", phase.u.upper)) if np.isfinite(v[i])}
        made.add_control(f"u{i}", targets=[f"u{i}"], continuity=True, rate_continuity=False, **bounds)
    made.add_objective("time" if least_time else "cost", loc="final")
    problem = om.Problem(reports=False)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", maxiter=500, tol=1e-8, disp=False)
    problem.driver.declare_coloring(show_summary=False)
    trajectory = problem.model.add_subsystem("trajectory", dm.Trajectory())
    trajectory.add_phase("phase", made)
    problem.setup()
    end = np.where(np.isfinite(phase.end), phase.end, phase.start)
    made.set_time_val(initial=0.0, duration=guess.duration)
    for i in range(nx):
        made.set_state_val(f"x{i}", [phase.start[i], end[i]])
    if not least_time:
        made.set_state_val("cost", [0.0, 1.0])  # it begins at 0; left out, dymos begins at 1
    for i in range(nu):
        made.set_control_val(f"u{i}", guess.controls(np.array([0.0, 1.0]))[i])
    problem.final_setup()
    ready = processor_time()
    dm.run_problem(problem, run_driver=True, simulate=False, make_plots=False)
    cost = float(np.ravel(problem.get_val("trajectory.phase.t" if least_time else "trajectory.phase.timeseries.cost"))[-1])
    result = problem.driver.result
    return Solved(cost, bool(result.success), int(result.iter_count), ready - began, processor_time() - ready)


def _component(base: Any, law: ca.Function, nx: int, nu: int) -> Any:
    """The law as a component of OpenMDAO, with exact partial derivatives at every node."""
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    values = ca.vertcat(*law(x, u))
    both = ca.vertcat(x, u)
    value, slopes = (
        ca.Function("value", [both], [values]),
        ca.Function("slopes", [both], [ca.vec(ca.densify(ca.jacobian(values, both)))]),
    )
    inputs, outputs = [*(f"x{i}" for i in range(nx)), *(f"u{i}" for i in range(nu))], [*(f"dx{i}" for i in range(nx)), "rate"]

    class Law(base):
        def initialize(self):
            self.options.declare("num_nodes", types=int)

        def setup(self):
            nodes = self.options["num_nodes"]
            for name in inputs:
                self.add_input(name, shape=(nodes,))
            for name in outputs:
                self.add_output(name, shape=(nodes,))
            self.declare_partials("*", "*", rows=np.arange(nodes), cols=np.arange(nodes))

        def compute(self, inputs_, outputs_):
            found = np.array(value.map(self.options["num_nodes"])(np.array([inputs_[name] for name in inputs])))
            for name, row in zip(outputs, found, strict=True):
                outputs_[name] = row

        def compute_partials(self, inputs_, partials):
            found = np.array(slopes.map(self.options["num_nodes"])(np.array([inputs_[name] for name in inputs])))
            for k, name in enumerate(inputs):
                for i, of in enumerate(outputs):
                    partials[of, name] = found[k * len(outputs) + i]

    return Law


def opty(known: Known, intervals: int) -> Solved:
    """opty with the midpoint rule and IPOPT, its objective made by opty itself."""
    parts = zip(known.problem.phases, known.guess.phases, known.laws, strict=True)
    return summed([_opty_phase(*part, intervals, known.least_time) for part in parts])


def _opty_phase(phase: Phase, guess: PhaseGuess, law: Any, intervals: int, least_time: bool) -> Solved:
    import sympy as sm
    from opty import Problem as Collocated
    from opty.utils import create_objective_function

    began = processor_time()
    t, h, nodes = sm.Symbol("t"), sm.Symbol("h"), intervals + 1
    x = [sm.Function(f"x{i}")(t) for i in range(len(phase.x))]
    u = [sm.Function(f"u{i}")(t) for i in range(len(phase.u))]
    rates, rate = law(x, u)
    equations = sm.Matrix([s.diff(t) - r for s, r in zip(x, rates, strict=True)])
    fixed = phase.duration[0] == phase.duration[1]
    step, free = (phase.duration[0] / intervals, []) if fixed else (h, [h])
    total = intervals * h if least_time else step * sm.Integral(rate, t)
    goal, slope = create_objective_function(total, x, u, free, nodes, 1.0, "midpoint", time_symbol=t)
    ends = [s.func(0 * step) - v for s, v in zip(x, phase.start, strict=True) if np.isfinite(v)]
    ends += [s.func(intervals * step) - v for s, v in zip(x, phase.end, strict=True) if np.isfinite(v)]
    bounds = {s: (a, b) for s, a, b in zip(x, phase.x.lower, phase.x.upper, strict=True) if np.isfinite([a, b]).any()}
    bounds |= {s: (a, b) for s, a, b in zip(u, phase.u.lower, phase.u.upper, strict=True) if np.isfinite([a, b]).any()}
    if not fixed:
        bounds[h] = (phase.duration[0] / intervals, phase.duration[1] / intervals)
    problem: Any = Collocated(
        goal, slope, equations, x, nodes, step,
        instance_constraints=tuple(ends), bounds=bounds, integration_method="midpoint", time_symbol=t,
        backend="numpy",  # compiling takes ten seconds and more, far longer than these problems
    )  # fmt: skip
    problem.add_option("print_level", 0)
    problem.add_option("sb", "yes")
    s = np.linspace(0, 1, nodes)
    start = np.concatenate([guess.states(s).ravel(), guess.controls(s).ravel(), [] if fixed else [guess.duration / intervals]])
    ready = processor_time()
    found, info = problem.solve(start)
    return Solved(float(goal(found)), info["status"] in (0, 1), len(problem.obj_value), ready - began, processor_time() - ready)


TOOLS: dict[str, Callable[[Known, int], Solved]] = {
    "rrr_oc, Gauss 3": ours,
    "CasADi Opti, trapezoid": opti("trapezoid"),
    "CasADi Opti, Hermite–Simpson": opti("simpson"),
    "dymos, order 3, SLSQP": dymos(3),
    "dymos, order 5, SLSQP": dymos(5),
    "opty, midpoint": opty,
}


def row(known: Known, tool: Callable[[Known, int], Solved]) -> dict[str, Any]:
    """The first mesh that is close enough; else the closest of those that converged, or the last."""
    rows: list[dict[str, Any]] = []
    for intervals in MESHES:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of deprecations within the tools
            found = tool(known, intervals)
        off = found.cost / known.cost - 1
        rows.append(
            {
                "known_cost": known.cost,
                "intervals": intervals,
                "cost": found.cost,
                "cost_error": off,
                "converged": found.converged,
            }
        )
        rows[-1] |= {"iterations": found.iterations, "set_up_s": found.set_up, "solve_s": found.solving}
        if (found.converged and abs(off) <= CLOSE) or found.solving > LONGEST:
            break
    converged = [r for r in rows if r["converged"]]
    return min(converged, key=lambda r: abs(r["cost_error"])) if converged else rows[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    parser.add_argument("--only", help="one problem: rayleigh, brachistochrone or stiff")
    options = parser.parse_args()
    out = options.out.resolve() / "optimal_control"
    for known in problems(options.only):
        for name, tool in TOOLS.items():
            path = out / f"{known.name} {name}.json"
            if path.exists():
                continue
            with tempfile.TemporaryDirectory() as folder:
                here = Path.cwd()
                os.chdir(folder)  # dymos leaves files where it is run
                try:
                    found = row(known, tool)
                except ModuleNotFoundError as missing:
                    print(f"{name}: left out, since it is not installed: {missing}", flush=True)
                    continue
                finally:
                    os.chdir(here)
            write_json(path, {"problem": known.title, "tool": name} | found)
            print(f"{known.name}, {name}: {found}", flush=True)


if __name__ == "__main__":
    main()
