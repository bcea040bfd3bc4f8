"""Do the symbolic dynamics and the physics engine agree: at states, along tracked motions, and at which order in the step?

    python validation/analytic_vs_mujoco.py [--out results/analytic_vs_mujoco] [--figure-only]

Three comparisons, in `analytic_vs_mujoco.json`, `.md` and `.png`:

States: torques of CasADi's inverse dynamics against `mj_inverse` at random q, dq, ddq and payloads, for every effect of the
catalogue that the engine twin takes. Effects on the links: generated C against the smoothed law, MuJoCo's own tendons against
the exact one. Effects in the drives: MuJoCo's own joint properties against the exact law.

Free motion: the arm let go, its controllers off, against an 8th-order Runge–Kutta solution of CasADi's forward dynamics. It
shows the integrators' own order.

Tracked motion: the paper's task as quintics from rest to rest under the paper's controllers with feed-forward, against CasADi's
inverse dynamics on the reference. It shows what E1, torques and positions of a re-simulated optimum are worth at a step.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import argparse
import json
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import mujoco
import numpy as np
from mujoco import rollout
from scipy.integrate import solve_ivp

from rrr_oc.effects import CATALOGUE, Effect
from rrr_oc.errors import UserError
from rrr_oc.model import metrics
from rrr_oc.model.symbolic_model import Model
from rrr_oc.report.figures import save_figure
from rrr_oc.robot.robot import BUNDLED, load_robot
from rrr_oc.simulation.engine_model import Controller, Form, Integrator, Settings, Twin, twin
from rrr_oc.simulation.tracking import ReferencePhase, track
from rrr_oc.storage import write_json, write_text

INTEGRATORS: tuple[Integrator, ...] = ("euler", "implicitfast", "implicit", "rk4")
FORMS: tuple[Form, ...] = get_args(Form)
STEPS = (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4)  # s
STATES, SEED = 300, 0
SLOW = 0.3  # rad/s; MuJoCo's dry friction is a soft constraint, which opposes ddq + 2/(0.02 s) dq and only so, when fast, dq
FREE_TIME, FREE_DAMPING = 0.5, 0.5  # s, Nm s/rad
# Below these nothing is measured but what the comparison's own reference leaves: the adaptive solution's tolerance, the
# feed-forward's interpolation across a spring's kink between POINTS a phase, quadrature, and rounding over 18000 steps.
POINTS = 100001
FLOORS = {"free": 1e-13, "position": 1e-10, "torque": 1e-5, "E1": 1e-9}
UNITS = {"free": "rad", "position": "rad", "torque": "Nm", "E1": "1"}
PHASES = {"go": (2.0, 5.0), "return": (2.5, 0.0)}  # duration [s], payload [kg]
ENDS = ((0, 75.52, -151.04), (0, 48.19, -96.38))  # start and release [°]
SPRINGS = {
    "taut": np.array([1.0, 5.0, 0.2, 4.0, 0.5, 0.6, -5.0]),  # all springs pull all the way, in both motions
    "slack on the way": np.array([8.3, 1.05, 0.4, -2.2, 36.0, 0.6, 0.21]),
}


TITLES = {
    "free": "Free motion: error of position after 0.5 s",
    "position": "Tracked: largest error of position",
    "torque": "Tracked: largest error of load torque",
    "E1": "Tracked: relative error of E1",
}
FORM_LABELS = {"generated": "generated C, smoothed law", "native": "MuJoCo's own, exact law"}
FORM_STYLES = {"generated": {"ls": "-", "fillstyle": "full"}, "native": {"ls": (0, (5, 4)), "fillstyle": "none"}}
STYLES = {  # many lines coincide: the earlier ones are drawn wider, so that they show under the later ones
    "euler": {"color": "#e8a33d", "marker": "s", "lw": 4.0, "ms": 10},
    "implicitfast": {"color": "#548235", "marker": "v", "lw": 3.0, "ms": 8},
    "implicit": {"color": "#7030a0", "marker": "^", "lw": 1.2, "ms": 5},
    "rk4": {"color": "#1f4e79", "marker": "o", "lw": 1.4, "ms": 5},
}


@dataclass(frozen=True)
class StateRow:
    """One line of the first table: the largest difference of torque, and the largest torque of the effect [Nm]."""

    robot: str
    effect: str
    form: str
    difference: float | None
    torque: float
    remark: str = ""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Analytic against engine torques: states, motions, integrators, steps.")
    parser.add_argument("--out", type=Path, default=Path("results/analytic_vs_mujoco"), help="folder of the results")
    parser.add_argument("--figure-only", action="store_true", help="draw figure and table again from the saved json")
    arguments = parser.parse_args()
    saved = arguments.out / "analytic_vs_mujoco.json"
    if not arguments.figure_only:
        began = time.perf_counter()
        results = {"states": [vars(row) for row in compare_states()], "motions": compare_motions()}
        versions = {"python": platform.python_version(), **{name: version(name) for name in ("casadi", "mujoco", "numpy")}}
        write_json(
            saved, {"versions": versions, "seed": SEED, "seconds": time.perf_counter() - began, "floors": FLOORS, **results}
        )
    results = json.loads(saved.read_text())
    write_text(arguments.out / "analytic_vs_mujoco.md", table(results))
    draw(results, arguments.out / "analytic_vs_mujoco.png")
    print(table(results))


# States


def compare_states() -> list[StateRow]:
    """Every effect of the catalogue on every bundled arm, and the bare arm."""
    rows = []
    for name in BUNDLED:
        robot = load_robot(name)
        rows.append(_compare_state(Model(robot, robot.tool), "generated", "none (rigid body)"))
        for kind in CATALOGUE.values():
            effects = None if kind.name in ("empirical", "link_inertial") else _placed(kind, robot.n)
            if effects is None:
                rows.append(
                    StateRow(
                        name, kind.name, "–", None, 0.0, "not placed: no torque of the instant, or no values drawn at random"
                    )
                )
                continue
            model = Model(robot, robot.tool, effects)
            forms: tuple[Form, ...] = FORMS if kind.side == "link" else ("native",)
            if kind.width is not None and kind.width.unit == "rad/s":
                rows += [_compare_state(model, form, f"{kind.name}, every speed above {SLOW} rad/s", SLOW) for form in forms]
                rows += [_compare_state(model, form, f"{kind.name}, every speed below {SLOW} rad/s", -SLOW) for form in forms]
            else:
                rows += [_compare_state(model, form, kind.name) for form in forms]
    return rows


def _placed(kind: type[Effect], n: int) -> tuple[Effect, ...] | None:
    """The effect on all joints, on neighbouring pairs where it spans two, or once where it belongs to the arm."""
    if kind.side in ("motion", "sensor") or kind.states or kind.placement == "spring":
        return None
    places = {"arm": [()], "pair": [(j, j + 1) for j in range(n - 1)]}.get(kind.placement, [(j,) for j in range(n)])
    return tuple(kind(place) for place in places)


def _compare_state(model: Model, form: Form, label: str, speeds: float = 0.0) -> StateRow:
    """A line of the table; all joints faster than `speeds` [rad/s], or where that is negative, slower than −`speeds`."""
    rng, n, name = np.random.default_rng(SEED), model.robot.n, model.robot.name
    theta = np.array([_value(p, rng) for p in model.parameters])
    widths = model.widths if form == "generated" else np.zeros_like(model.widths)
    shown = FORM_LABELS[form]
    try:
        engine = twin(model, theta, settings=Settings(effects=form), widths=widths)
    except UserError as error:
        return StateRow(name, label, shown, None, 0.0, str(error).split("; ")[0])
    largest = scale = 0.0
    with engine.effects():
        for payload in (0.0, 5.0):
            engine.grip(payload)
            for q, dq, ddq in _states(rng, n, speeds):
                arguments = (q, dq, ddq, 0.0, payload, theta, widths, model.robot.inertial)
                motor = np.asarray(model.motor_inverse(*arguments)[0]).ravel()
                bare = (
                    np.asarray(Model(model.robot, model.tool).inverse(q, dq, ddq, payload, [], [])[0]).ravel()
                    if model.effects
                    else 0.0
                )
                largest = max(largest, float(np.max(np.abs(_engine_inverse(engine, q, dq, ddq) - motor))))
                scale = max(scale, float(np.max(np.abs(motor - bare))))
    return StateRow(name, label, "–" if not model.effects else shown, largest, scale)


def _value(parameter, rng: np.random.Generator) -> float:
    """A random value of a parameter, within its bounds: around its nominal value, of the order of 1 where that is 0."""
    spread = max(abs(parameter.nominal), 1.0)
    low, high = max(parameter.lower, parameter.nominal - spread), min(parameter.upper, parameter.nominal + spread)
    return float(rng.uniform(low, high))


def _states(rng: np.random.Generator, n: int, speeds: float):
    count = STATES // 2
    dq = rng.normal(0, 2, (count, n))
    dq = rng.uniform(speeds, -speeds, (count, n)) if speeds < 0 else dq + speeds * np.sign(dq)
    return zip(rng.uniform(-3, 3, (count, n)), dq, rng.normal(0, 5, (count, n)), strict=True)


def _engine_inverse(engine: Twin, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    d = mujoco.MjData(engine.mj)
    d.qpos[:], d.qvel[:], d.qacc[:] = q, dq, ddq
    mujoco.mj_inverse(engine.mj, d)
    return d.qfrc_inverse.copy()


# Motions


def spring_arm() -> Model:
    """The arm of the paper with the springs of PEA+BPEA."""
    robot, parallel = load_robot("rrr"), CATALOGUE["parallel_spring"]
    return Model(robot, robot.tool, (parallel((1,)), parallel((2,)), CATALOGUE["biarticular_spring"]((1, 2))))


def compare_motions() -> list[dict]:
    """Errors of free and tracked motions over springs, forms, integrators and steps."""
    model, results = spring_arm(), []
    for springs, theta in SPRINGS.items():
        for form in FORMS:
            widths = model.widths if form == "generated" else np.zeros(3)
            end = exact_free_motion(model, theta, widths)
            phases = reference(model, theta, widths)
            E1 = float(np.sum(metrics.E1([(p.t, p.tau_load) for p in phases])))
            for integrator in INTEGRATORS:
                rows = []
                for step in STEPS:
                    settings = Settings(effects=form, timestep=step, integrator=integrator)
                    free = float(np.max(np.abs(free_motion(model, theta, widths, settings) - end)))
                    rows.append({"free": free, **_tracking_errors(model, phases, theta, settings, widths, E1)})
                errors = {key: [row[key] for row in rows] for key in FLOORS}
                orders = {key: order(STEPS, errors[key], FLOORS[key]) for key in FLOORS}
                results.append(
                    {
                        "springs": springs,
                        "form": form,
                        "integrator": integrator,
                        "steps": STEPS,
                        "errors": errors,
                        "orders": orders,
                    }
                )
    return results


def free_start() -> tuple[np.ndarray, np.ndarray]:
    """q [rad], dq [rad/s] of the free motion."""
    return np.array([0.1, 1.2, -2.0]), np.array([0.3, -0.2, 0.4])


def exact_free_motion(model: Model, theta: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """q at the end of the free motion [rad], by DOP853 on CasADi's forward dynamics, in steps that no kink hides in."""
    n = model.robot.n

    def rates(_, x: np.ndarray) -> np.ndarray:
        q, dq = x[:n], x[n:]
        return np.concatenate([dq, np.asarray(model.forward(q, dq, -FREE_DAMPING * dq, 0.0, theta, widths)).ravel()])

    x = np.concatenate(free_start())
    return solve_ivp(rates, (0, FREE_TIME), x, "DOP853", rtol=1e-13, atol=1e-13, max_step=1e-3).y[:n, -1]


def free_motion(model: Model, theta: np.ndarray, widths: np.ndarray, settings: Settings) -> np.ndarray:
    """q at the end of the engine's free motion [rad]."""
    off, n = np.zeros(model.robot.n), model.robot.n
    engine = twin(model, theta, Controller(off, off, np.full(n, np.inf)), replace(settings, damping=FREE_DAMPING), widths)
    d = mujoco.MjData(engine.mj)
    d.qpos[:], d.qvel[:] = free_start()
    physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros(mujoco.mj_stateSize(engine.mj, physics))
    mujoco.mj_getState(engine.mj, d, initial, physics)
    with engine.effects():
        states, _ = rollout.rollout(engine.mj, d, initial, nstep=round(FREE_TIME / settings.timestep))
    return np.asarray(states)[0, -1, 1 : n + 1]


def quintic(phase: str, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq, ddq (n, K) of a phase of the task: from rest to rest."""
    T, a, b = PHASES[phase][0], *np.radians(ENDS if phase == "go" else ENDS[::-1])
    s, d = t / T, (b - a)[:, None]
    return (
        a[:, None] + d * (10 * s**3 - 15 * s**4 + 6 * s**5),
        d * 30 * (s * (1 - s)) ** 2 / T,
        d * (60 * s - 180 * s**2 + 120 * s**3) / T**2,
    )


def reference(model: Model, theta: np.ndarray, widths: np.ndarray) -> list[ReferencePhase]:
    """The task with its analytic load torques."""
    phases = []
    for name, (T, payload) in PHASES.items():
        t = np.linspace(0, T, POINTS)
        motion = quintic(name, t)
        load = np.asarray(model.inverse(*motion, payload, theta, widths)[0])
        phases.append(ReferencePhase(name, t, *motion, payload, load))
    return phases


def _tracking_errors(
    model: Model, phases, theta: np.ndarray, settings: Settings, widths: np.ndarray, E1: float
) -> dict[str, float]:
    """Largest errors of q [rad] and tau_load [Nm] over joints and times, against the reference, and the relative one of E1."""
    result = track(model, phases, theta, settings=settings, widths=widths)
    position = torque = 0.0
    for phase in result.phases:
        motion = quintic(phase.name, phase.t)
        load = np.asarray(model.inverse(*motion, phase.payload, theta, widths)[0])
        position = max(position, float(np.max(np.abs(phase.q - motion[0]))))
        torque = max(torque, float(np.max(np.abs(phase.tau_load - load))))
    return {"position": position, "torque": torque, "E1": abs(result.metrics.E1_total / E1 - 1)}


def order(steps: Sequence[float], errors: Sequence[float], floor: float) -> float | None:
    """Least-squares slope of log error over log step above the floor, less the longest step where 3 others remain."""
    above = [(h, e) for h, e in zip(steps, errors, strict=True) if e > floor]
    above = above[1:] if len(above) > 3 else above
    if len(above) < 2:
        return None
    h, e = np.log(np.array(above)).T
    return float(np.polyfit(h, e, 1)[0])


# Table and figure


def table(results: dict) -> str:
    """The results as Markdown."""
    lines = [
        "# Analytic against engine",
        "",
        f"CasADi {results['versions']['casadi']}, MuJoCo {results['versions']['mujoco']}; "
        f"{STATES} random states a line (half of them with 5 kg), seed {results['seed']}; {results['seconds']:.0f} s.",
        "",
        "## Torques at random states",
        "",
        "| arm | effect | form in the engine | largest torque of the effect [Nm] | largest difference [Nm] |",
        "|---|---|---|---|---|",
    ]
    for row in results["states"]:
        difference = row["remark"] if row["difference"] is None else f"{row['difference']:.1e}"
        lines.append(f"| {row['robot']} | {row['effect']} | {row['form']} | {row['torque']:.3g} | {difference} |")
    for key, title in TITLES.items():
        lines += ["", f"## {title} [{UNITS[key]}]", ""]
        steps = results["motions"][0]["steps"]
        lines += ["| springs | form | integrator | " + " | ".join(f"{1e3 * h:g} ms" for h in steps) + " | order |"]
        lines += ["|---" * (len(steps) + 4) + "|"]
        for m in results["motions"]:
            numbers = " | ".join(f"{e:.1e}" for e in m["errors"][key])
            slope = "–" if m["orders"][key] is None else f"{m['orders'][key]:.2f}"
            lines.append(f"| {m['springs']} | {m['form']} | {m['integrator']} | {numbers} | {slope} |")
    lines += [
        "",
        "Order: least-squares slope of log error over log step, without the longest step, above "
        + ", ".join(f"{FLOORS[k]:g} {UNITS[k]} ({k})" for k in FLOORS)
        + ", below which the comparison's own reference limits it; – where fewer than two steps lie above.",
    ]
    return "\n".join(lines) + "\n"


def draw(results: dict, path: Path) -> None:
    """Errors over the step, log–log: one column a quantity, one row a set of springs."""
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullLocator

    fig, panels = plt.subplots(len(SPRINGS), len(TITLES), figsize=(14, 7), sharex=True, sharey="col", layout="constrained")
    for row, springs in zip(panels, SPRINGS, strict=True):
        for panel, (key, title) in zip(row, TITLES.items(), strict=True):
            chosen = [m for m in results["motions"] if m["springs"] == springs]
            for m in sorted(chosen, key=lambda m: list(STYLES).index(m["integrator"])):
                style = STYLES[m["integrator"]] | FORM_STYLES[m["form"]]
                if m["form"] == "native":
                    style |= {"ms": style["ms"] + 4, "lw": 1.0}
                panel.loglog(1e3 * np.array(m["steps"]), np.maximum(m["errors"][key], 1e-16), **style)
            _slopes(panel, chosen, key)
            panel.axhline(FLOORS[key], color="0.6", lw=0.8, ls=":")
            panel.set_xticks([1e3 * h for h in STEPS], [f"{1e3 * h:g}" for h in STEPS])
            panel.xaxis.set_minor_locator(NullLocator())
            panel.grid(alpha=0.3)
            panel.set_title(f"{title.split(':')[0]}, springs {springs}", fontsize=9)
            panel.set_ylabel(f"{title.split(': ')[1]} [{UNITS[key]}]", fontsize=9)
    for panel in panels[-1]:
        panel.set_xlabel("time step [ms]", fontsize=9)
    handles = [Line2D([], [], label=name, **style) for name, style in STYLES.items()]
    handles += [
        Line2D([], [], color="0.3", marker="o", label=label, **FORM_STYLES[form]) for form, label in FORM_LABELS.items()
    ]
    handles += [Line2D([], [], color="0.6", lw=0.8, ls=":", label="floor of the comparison")]
    handles += [Line2D([], [], color="0.82", label="slopes 1, 2, 4")]
    fig.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    save_figure(fig, path)


def _slopes(panel, motions: list[dict], key: str) -> None:
    """Grey guides from above the largest error at the longest step, with their slopes."""
    top = max(m["errors"][key][0] for m in motions)
    h = np.array(STEPS)
    for slope in (1, 2, 4):
        guide = 3 * top * (h / h[0]) ** slope
        shown = guide > FLOORS[key]
        panel.loglog(1e3 * h[shown], guide[shown], color="0.82", lw=1, zorder=0)
        panel.annotate(str(slope), (1e3 * h[shown][-1], guide[shown][-1]), color="0.5", fontsize=8, ha="right", va="center")


if __name__ == "__main__":
    main()
