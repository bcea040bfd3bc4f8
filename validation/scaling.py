"""What does one solve cost, as the mesh grows finer and the arm longer?

Chains of 3, 6 and 7 joints carry a payload from rest to rest and come back empty, every joint moving, E1 the cost, durations
free; Lobatto IIIA with 4 stages on 20 to 320 intervals a phase. Measured: building the program with its exact derivatives,
solving it with IPOPT, iterations, time an iteration. The numbers go to `scaling.json`, a table (Markdown) and a figure (PNG).

    python validation/scaling.py [--out results/scaling] [--repeats 3] [--figure-only]
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import product
from pathlib import Path

import numpy as np

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import motion_guess
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.optimal_control.refinement import mesh_error
from rrr_oc.optimal_control.scheme import scheme, uniform_mesh
from rrr_oc.optimal_control.solver import Options, Solver
from rrr_oc.optimal_control.transcription import Transcription
from rrr_oc.report.figures import save_figure
from rrr_oc.storage import write_json, write_text

INTERVALS = (20, 40, 80, 160, 320)
JOINTS = (3, 6, 7)
PAYLOAD = 3.0  # kg
AXES = (
    "0 0 1",
    "0 -1 0",
    "0 -1 0",
    "1 0 0",
    "0 -1 0",
    "1 0 0",
    "0 -1 0",
)  # yaw, two pitches, then wrist roll and pitch in turn
START = (-40.0, 70.0, -120.0, 20.0, 40.0, -30.0, 20.0)  # °
RELEASE = (20.0, 35.0, -60.0, -20.0, 10.0, 30.0, -20.0)  # °
OPTIONS = Options(tolerance=1e-8)


@dataclass(frozen=True)
class Row:
    """One solve.

    Attributes:
        joints, intervals: Of the chain; a phase.
        variables, constraints: Of the nonlinear program.
        build, solve: Wall time [s], the fastest of the repeats; the generated C comes from the cache.
        iterations: Of IPOPT.
        cost: E1 [N²m²s].
        error: Between the nodes, relative.
    """

    joints: int
    intervals: int
    variables: int
    constraints: int
    build: float
    solve: float
    iterations: int
    cost: float
    error: float


def chain(joints: int) -> str:
    """URDF of an arm of so many joints: links tapering from 5 kg and 0.3 m by a quarter each."""
    parts, length = ['<link name="base"/>'], 0.0
    for i in range(joints):
        mass, reach = 5 * 0.75**i, 0.3 * 0.75 ** max(i - 1, 0)
        moment = mass * reach**2 / 12
        parent = "base" if i == 0 else f"link{i}"
        offset = f"0 0 {length:.4f}" if i == 1 else f"{length:.4f} 0 0"
        parts.append(
            f'<link name="link{i + 1}"><inertial><origin xyz="{reach / 2:.4f} 0 0"/><mass value="{mass:.4f}"/>'
            f'<inertia ixx="{moment / 5:.6f}" iyy="{moment:.6f}" izz="{moment:.6f}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint{i + 1}" type="revolute"><parent link="{parent}"/><child link="link{i + 1}"/>'
            f'<origin xyz="{offset}"/><axis xyz="{AXES[i]}"/><limit lower="-3" upper="3" effort="200" velocity="2"/></joint>'
        )
        length = 0.1 if i == 0 else reach
    return f'<?xml version="1.0"?><robot name="chain{joints}">{"".join(parts)}</robot>'


def task(joints: int) -> Task:
    """The payload's way there and back, for a chain; through a task file as a user's would be."""
    names = [f"joint{i + 1}" for i in range(joints)]
    content = {
        "format": "rrr_oc-task/1",
        "name": f"{joints} joints",
        "robot": "chain.urdf",
        "moving": names,
        "tool": {"link": names[-1].replace("joint", "link"), "position_m": [0.1, 0, 0]},
        "start": {"angles_deg": START[:joints]},
        "release": {"angles_deg": RELEASE[:joints]},
        "payload_kg": PAYLOAD,
        "duration_s": [1.0, 2.0],
        "limits": {n: {"speed_deg_per_s": 90, "acceleration_deg_per_s2": 180, "torque_Nm": "none"} for n in names},
    }
    with tempfile.TemporaryDirectory() as folder:
        write_text(Path(folder) / "chain.urdf", chain(joints))
        write_json(Path(folder) / "task.json", content)
        return load_task(Path(folder) / "task.json")


def measure(joints: int, intervals: int, repeats: int) -> Row:
    """Build and solve afresh, `repeats` times, from a straight minimum-jerk motion of 1.4 s a phase."""
    chosen, builds, solutions = task(joints), [], []
    for _ in range(max(repeats, 1)):
        began, design = time.perf_counter(), CoDesign(chosen, ())
        transcription = Transcription(
            design.problem, scheme("lobatto", 4), uniform_mesh(design.problem, intervals), compiled=True
        )
        solution = Solver(transcription, OPTIONS).solve(motion_guess(design, np.zeros(0), (1.4, 1.4)))
        builds.append(time.perf_counter() - began - solution.seconds)  # `seconds` is IPOPT alone
        solutions.append(solution)
    best = min(solutions, key=lambda s: s.seconds)
    size, rows = best.w.size, best.lam_g.size
    return Row(joints, intervals, size, rows, min(builds), best.seconds, best.iterations, best.cost, mesh_error(best).largest)


def table(results: dict) -> str:
    """Markdown: every solve, then the exponents of time over intervals."""
    names = ("joints", "intervals", "variables", "constraints", "build [s]", "solve [s]", "iterations", "ms an iteration")
    header = "| " + " | ".join((*names, "E1", "mesh error")) + " |"
    lines = ["# Cost of one solve\n", header, "|" + "---|" * 10]
    for r in results["rows"]:
        cells = [r["joints"], r["intervals"], r["variables"], r["constraints"], f"{r['build']:.3f}", f"{r['solve']:.3f}"]
        cells += [r["iterations"], f"{1e3 * r['solve'] / r['iterations']:.2f}", f"{r['cost']:.3f}", f"{r['error']:.1e}"]
        lines.append("| " + " | ".join(str(c) for c in cells) + " |")
    lines += ["", "Exponents of time an iteration and of building over the intervals, least squares in logarithms:", ""]
    for joints in JOINTS:
        rows = [r for r in results["rows"] if r["joints"] == joints]
        each = [exponent(rows, lambda r: r["solve"] / r["iterations"]), exponent(rows, lambda r: r["build"])]
        lines.append(f"- {joints} joints: iteration {each[0]:.2f}, build {each[1]:.2f}")
    machine = results["machine"]
    lines.append(
        f"\nOn {machine['cores']} cores ({machine['processor']}), load {machine['load']:.1f} at the start; the fastest of "
        f"{results['repeats']} runs, compiled code from the cache. Gravity, E1 and 3 kg of payload as in `validation/scaling.py`."
    )
    return "\n".join(lines) + "\n"


def exponent(rows: list[dict], value: Callable[[dict], float]) -> float:
    """b of value ∝ intervals^b."""
    return float(np.polyfit(np.log([r["intervals"] for r in rows]), np.log([value(r) for r in rows]), 1)[0])


def figure(results: dict, path: Path) -> None:
    """Times over intervals, log–log, from the saved results: the solve, one iteration, and the build."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    panels = (
        ("one solve by IPOPT [s]", lambda r: r["solve"]),
        ("one iteration [ms]", lambda r: 1e3 * r["solve"] / r["iterations"]),
        ("building program and derivatives [s]", lambda r: r["build"]),
    )
    fig, axes = plt.subplots(1, 3, figsize=(12.5, 4.4), layout="constrained")
    for axis, (title, value) in zip(axes, panels, strict=True):
        for joints, colour, marker in zip(JOINTS, ("#1f4e79", "#c55a11", "#548235"), "os^", strict=True):
            rows = [r for r in results["rows"] if r["joints"] == joints]
            x, y = [r["intervals"] for r in rows], [value(r) for r in rows]
            axis.loglog(x, y, marker=marker, color=colour, lw=1.6, ms=6, label=f"{joints} joints")
            if axis is axes[0]:
                for r, height in zip(rows, y, strict=True):
                    below = joints < 7
                    place = {"xytext": (0, -12 if below else 7), "textcoords": "offset points", "ha": "center"}
                    axis.annotate(str(r["iterations"]), (r["intervals"], height), fontsize=7.5, color=colour, **place)
        if axis is not axes[2]:
            guide = 0.35 * min(value(r) for r in results["rows"]) * np.array(INTERVALS) / INTERVALS[0]
            axis.loglog(INTERVALS, guide, color="0.6", lw=1, ls="--", label="∝ intervals")
        axis.set_xticks(INTERVALS, [str(n) for n in INTERVALS])
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set_xlabel("intervals a phase")
        axis.set_title(title, fontsize=10.5)
        axis.grid(alpha=0.3, which="both", lw=0.6)
    axes[0].legend(fontsize=8.5, loc="upper left")
    axes[0].margins(y=0.12)
    fig.supxlabel("two phases, Lobatto IIIA with 4 stages; small numbers: iterations", fontsize=8.5, color="0.35")
    save_figure(fig, path)


def processor() -> str:
    """The processor's name where the system tells it."""
    info = Path("/proc/cpuinfo")
    names = (
        [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        if info.is_file()
        else []
    )
    return names[0] if names else platform.processor() or platform.machine()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Cost of one solve against intervals and joints.")
    parser.add_argument("--out", type=Path, default=Path("results/scaling"), help="folder of the results")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each, of which the fastest counts")
    parser.add_argument("--figure-only", action="store_true", help="draw the figure and table again from the saved json")
    arguments = parser.parse_args()
    saved = arguments.out / "scaling.json"
    if not arguments.figure_only:
        began = time.perf_counter()
        machine = {
            "processor": processor(),
            "cores": os.cpu_count(),
            "load": os.getloadavg()[0],
            "python": platform.python_version(),
        }
        rows = []
        for joints, intervals in product(JOINTS, INTERVALS):
            rows.append(asdict(measure(joints, intervals, arguments.repeats)))
            print(f"{joints} joints, {intervals} intervals: {rows[-1]['solve']:.2f} s", flush=True)
        versions = {package: version(package) for package in ("casadi", "pin", "numpy")}
        results = {
            "machine": machine,
            "versions": versions,
            "options": asdict(OPTIONS),
            "repeats": arguments.repeats,
            "rows": rows,
        }
        write_json(saved, results | {"seconds": time.perf_counter() - began})
    results = json.loads(saved.read_text())
    write_text(arguments.out / "scaling.md", table(results))
    figure(results, arguments.out / "scaling.png")
    print(table(results))


if __name__ == "__main__":
    main()
