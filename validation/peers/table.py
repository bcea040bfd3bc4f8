"""The comparison with peers: everything that is not done yet is run, then the tables go to a page.

    python validation/concealed/make_cases.py --out cases --only single --seed 5001 --limit 20
    python validation/concealed/make_cases.py --out cases --only clean --seed 5001 --limit 12
    python validation/peers/table.py cases --out results/peers [--page docs/peers.md] [--tables-only]

README.md beside this file says how the peers are installed. A page has its tables between two comments, `<!-- tables -->` and
`<!-- end -->`; the rest of it is left alone.
"""

import argparse
import json
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from rrr_oc import __version__  # noqa: E402
from rrr_oc.report.tables import markdown  # noqa: E402
from rrr_oc.storage import write_text  # noqa: E402
from validation.peers.scores import scored, table_of  # noqa: E402

PARTS = ("rollouts.py", "optimal_control.py", "calibration.py")
PACKAGES = (
    "pysindy", "scikit-learn", "casadi", "dymos", "openmdao", "opty", "cyipopt-wheels", "mujoco", "figaroh", "numpy", "scipy",
)  # fmt: skip
BEGIN, END = "<!-- tables -->", "<!-- end -->"


def discovery_table(cases: Path, out: Path) -> list[str]:
    """What is concealed and who names it."""
    found = scored(cases, out)
    if not found:
        return []
    entries = next(iter(found.values()))
    there = sum("first" in e for e in entries)
    joints = [e["joints"] for e in entries]
    kinds = f"{there} with hidden effects and {len(entries) - there} without"
    head = f"{len(entries)} sealed cases, {kinds}, arms of {min(joints)} to {max(joints)} joints."
    lines = ["### Discovery", "", head, "", markdown(*table_of(found))]
    real = [json.loads(p.read_text(encoding="utf-8")) for p in sorted((out / "discovery" / "peers").glob("real_*.json"))]
    for peers in real:
        path = out / "discovery" / "rrr_oc" / f"{peers['case']}.json"
        rows = [["plain model", f"{peers['plain']:.3f}", "–", f"{peers['prepare_s']:.1f}"]]
        if path.exists():
            ours = json.loads(path.read_text(encoding="utf-8"))
            rows.append(["rrr_oc, diagnose", f"{ours['nrmse']:.3f}", str(len(ours["claims"])), f"{ours['seconds']:.1f}"])
        rows += [
            [k, f"{v['nrmse']:.3f}", str(len(v["claims"])), f"{v['seconds'] + peers['prepare_s']:.1f}"]
            for k, v in peers["ways"].items()
        ]
        lines += [f"`{peers['case'].removeprefix('real_')}`, recordings of a real arm:", ""]
        lines += [markdown(["tool; library", "NRMSE held out", "claims", "time [s]"], rows)]
    return lines


def optimal_control_table(out: Path) -> list[str]:
    """The first mesh that is close enough, of each problem and tool."""
    rows = []
    for path in sorted((out / "optimal_control").glob("*.json"), key=lambda p: p.stat().st_mtime):
        r = json.loads(path.read_text(encoding="utf-8"))
        status = "yes" if r["converged"] else "no"
        rows.append([
            r["problem"], r["tool"], str(r["intervals"]), f"{r['cost']:.6g}", f"{r['cost_error']:.1e}", status,
            "–" if r["iterations"] is None else str(r["iterations"]), f"{r['set_up_s'] + r['solve_s']:.2f}",
        ])  # fmt: skip
    rows.sort(key=lambda row: row[0])
    header = ["problem", "tool", "intervals a phase", "cost", "relative error", "converged", "iterations", "time [s]"]
    return ["### Optimal control", "", markdown(header, rows)] if rows else []


def rollouts_table(out: Path) -> list[str]:
    """Steps a second with and without effects."""
    path = out / "rollouts.json"
    if not path.exists():
        return []
    speeds = json.loads(path.read_text(encoding="utf-8"))
    words = {"bare": "no springs", "generated": "three springs, generated C", "native": "three springs of MuJoCo's own"}
    rows = [[words[form], f"{speed:,.0f}", f"{speed / speeds['bare']:.0%}"] for form, speed in speeds.items()]
    return ["### Rollouts", "", markdown(["in MuJoCo", "steps a second of one thread", "of the bare engine"], rows)]


def calibration_table(out: Path) -> list[str]:
    """Errors of parameters and of held-out torques."""
    rows = []
    for path in sorted((out / "calibration").glob("*.json")):
        r: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        errors = [f"{r[key]:.1%}" if r.get(key) is not None else "–" for key in ("coulomb", "viscous", "armature")]
        rows.append([r["set"], r["tool"], *errors, f"{r['nrmse']:.4f}", f"{r['seconds']:.2f}"])
    header = ["set", "tool", "dry friction off by", "viscous friction off by", "armature off by", "NRMSE held out", "time [s]"]
    return ["### Calibration", "", markdown(header, rows)] if rows else []


def versions() -> str:
    """Of what is installed."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name}: not installed")
    return f"rrr_oc {__version__}, Python {platform.python_version()}, {', '.join(found)}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    parser.add_argument("--page", type=Path, help="a page whose tables are replaced")
    parser.add_argument("--sets", type=Path, nargs="*", default=[], help="folders of real arms, each with train and test")
    parser.add_argument("--tables-only", action="store_true", help="run nothing")
    options = parser.parse_args()
    if not options.tables_only:
        here, out = Path(__file__).resolve().parent, str(options.out)
        sets = ["--sets", *map(str, options.sets)] if options.sets else []
        for part in PARTS:
            subprocess.run([sys.executable, str(here / part), "--out", out], check=True)
        subprocess.run([sys.executable, str(here / "discovery.py"), str(options.cases), "--out", out, *sets], check=True)
    parts = [discovery_table(options.cases, options.out), optimal_control_table(options.out), rollouts_table(options.out)]
    parts.append(calibration_table(options.out))
    text = "\n".join(line for part in parts for line in part) + f"\n{versions()}\n"
    write_text(options.out / "tables.md", text)
    if options.page is not None:
        page = options.page.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN, 1)
        write_text(options.page, f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END, 1)[1]}")
    print(text)


if __name__ == "__main__":
    main()
