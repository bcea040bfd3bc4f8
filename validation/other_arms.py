"""Does the search find the same optimum from every seed on arms of others, and do fewer springs or held postures never gain?

    python validation/other_arms.py arms --seeds 3 --out results/other_arms

`arms` is a folder with the robot files of PyPI's wheel `example-robot-data`, as in validation/every_arm.py. Eight tasks begin as `rrr-oc
init` writes them: a UR10 on a table, hung from a ceiling and on a wall; an xArm; a Panda of which three joints reach both ends in many
postures; a desktop arm; and a UR5 with motors that hardly hold the load, and with hardly any time. A spring across two joints is
offered beside those of each joint. The table has the best cost of each configuration over all seeds and by how much the seeds differ;
then whether more springs or free postures are ever worse. A search that is done is not done again.
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import offered
from rrr_oc.codesign.task import load_task
from rrr_oc.commands.init import write_example
from rrr_oc.errors import UserError, entry_point
from rrr_oc.optimal_control.refinement import Refinement
from rrr_oc.report.tables import markdown
from rrr_oc.schema import parsed
from rrr_oc.storage import Made, check_folder, read_utf8, write_json, write_text
from validation.search_seeds import write_searched

SPREAD = 0.005  # [1] by which seeds may differ
SLACK = 1e-3  # [1] by which fewer springs or held postures may seem better, as meshes differ
ACROSS = {"q_0_deg": [-180, 180], "r_1_mm": [14, 39], "r_2_mm": [19, 36], "r_3_mm": [14, 39]}  # of a spring across two joints


@dataclass(frozen=True)
class Case:
    """A task: a robot file, the joints of the arm and those that move, and what stands in the place of what `init` writes.

    Attributes:
        torque: Greatest torque of the moving joints [Nm]; the robot file's if none.
        held: Whether the ends' postures are held.
    """

    robot: str
    moving: tuple[str, ...]
    joints: tuple[str, ...] | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)
    torque: tuple[float, ...] = ()
    held: bool = False


UR = ("shoulder_lift_joint", "elbow_joint")
PANDA = tuple(f"panda_joint{i}" for i in range(1, 8))
PANDA_ENDS = {"start": {"position_m": [0.6, 0.0, 0.3]}, "release": {"position_m": [0.35, 0.0, 0.75]}}
CASES = {
    "UR10 on a table": Case("ur10_robot", UR),
    "UR10 on a ceiling": Case("ur10_robot", UR, changes={"gravity": [0.0, 0.0, 9.81]}),
    "UR10 on a wall": Case("ur10_robot", UR, changes={"gravity": [9.81, 0.0, 0.0]}),
    "xArm": Case("xarm7", ("joint2", "joint4")),
    "Panda, free postures": Case("panda", PANDA[1:6:2], PANDA, PANDA_ENDS),
    "Panda, held postures": Case("panda", PANDA[1:6:2], PANDA, PANDA_ENDS, held=True),
    "desktop arm": Case("so101", ("shoulder_lift", "elbow_flex")),
    "UR5, weak motors": Case("ur5_robot", UR, torque=(60.0, 25.0)),
    "UR5, little time": Case("ur5_robot", UR, changes={"duration_s": [0.5, 0.9]}),
}


def written(arms: Path, folder: Path, name: str) -> Path:
    """The file of a case's task, in a folder of its own."""
    case, file = CASES[name], folder / name.replace(",", "").replace(" ", "_") / "task.json"
    if file.exists():
        return file
    found = sorted(arms.rglob(f"{case.robot}.urdf"))
    if not found:
        raise UserError(f"{arms}: no {case.robot}.urdf below it; the wheel example-robot-data has it")
    write_example(found[0], file.parent, case.joints)
    task = parsed(str(file), read_utf8(file).decode())
    limits, stiffness = task["limits"], [s["stiffness_Nm_per_rad"] for s in task["springs"]]
    given = [limits.get(joint, {}) for joint in case.moving]
    for joint, own, torque in zip(case.moving, given, case.torque or [None] * len(given), strict=True):
        limits[joint] = own | ({} if torque is None else {"torque_Nm": torque})
    task |= {"moving": list(case.moving), "limits": {joint: limits[joint] for joint in case.moving}, "name": name}
    task["locked_deg"] = {j: a for j, a in task.get("locked_deg", {}).items() if j not in case.moving}
    task["springs"] = [
        {"effect": "parallel_spring", "joint": joint, "stiffness_Nm_per_rad": k, "equilibrium_deg": [-180, 180]}
        for joint, k in zip(case.moving, [*stiffness, stiffness[-1]], strict=False)
    ]
    across = {"effect": "biarticular_spring", "joints": list(case.moving[:2]), "k_b_Nm_per_rad": stiffness[0]}
    task["springs"].append(across | ACROSS)
    task |= case.changes
    if case.held:
        task |= {end: task[end] | {"posture": "held"} for end in ("start", "release")}
    write_json(file, task)
    return file


def checks(best: Mapping[tuple[str, str], float]) -> list[str]:
    """What is worse though it has more springs or free postures, from the best cost of each task and configuration."""
    parts = {key: {p for p in key[1].split("+") if p != "SA"} for key in best}
    pairs = [(a, b) for a in best for b in best if a[0] == b[0] and parts[a] < parts[b]]
    pairs += [((f"{t}, held postures", c), (f"{t}, free postures", c)) for t, c in _postures(best)]
    worse = [(a, b) for a, b in pairs if best[b] > best[a] * (1 + SLACK)]
    lines = [f"{len(pairs)} pairs of fewer and more springs, or held and free postures: {len(worse)} where more is worse."]
    lines += [f"{' with '.join(b)}: {best[b]:.5g}, {' with '.join(a)}: {best[a]:.5g}." for a, b in worse]
    for t, c in _postures(best):
        held, free = best[f"{t}, held postures", c], best[f"{t}, free postures", c]
        lines.append(f"{t} with {c}: free postures save {100 * (1 - free / held):.1f} %.")
    return lines


def _postures(best: Mapping[tuple[str, str], float]) -> list[tuple[str, str]]:
    free = [(t.removesuffix(", free postures"), c) for t, c in best if t.endswith(", free postures")]
    return [(t, c) for t, c in free if (f"{t}, held postures", c) in best]


def main(
    arms: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="folder below which robot files are searched")],
    out: Annotated[Path, typer.Option(help="folder of the results")],
    seeds: Annotated[int, typer.Option(min=1, help="number of seeds, from 0")] = 3,
    configurations: Annotated[str, typer.Option(help="comma-separated")] = "SA,PEA,PEA+BPEA",
    only: Annotated[str, typer.Option(help="tasks whose name begins so")] = "",
) -> None:
    """Search every task with every configuration from every seed, and write the table."""
    check_folder(out)
    files = {name: written(arms, out / "tasks", name) for name in CASES if name.startswith(only)}
    wanted = {name: [c for c in offered(load_task(str(f))) if c in configurations.split(",")] for name, f in files.items()}
    costs: dict[tuple[str, str], list[float]] = {}
    every = [(name, c, seed) for seed in range(seeds) for name in files for c in wanted[name]]
    for name, configuration, seed in track(every, "searches"):
        file = out / "searches" / f"{files[name].parent.name}_{configuration}_{seed}.json"
        options = SearchOptions(seed=seed, refinement=Refinement(1e-4))
        made = Made([file], [name, configuration, asdict(options)], [Path(__file__), files[name]])
        made.once(partial(write_searched, file, str(files[name]), configuration, options))
        costs.setdefault((name, configuration), []).append(json.loads(file.read_text())["cost"])
        rows = [
            [
                *key,
                f"{min(c):.5g}",
                str(len(c)),
                f"{100 * (max(c) / min(c) - 1):.2f} %",
                "yes" if max(c) > (1 + SPREAD) * min(c) else "",
            ]
            for key, c in costs.items()
        ]
        header = ["task", "springs", "best E1 [N²m²s]", "seeds", "they differ by", f"more than {100 * SPREAD:g} %"]
        best = {key: min(c) for key, c in costs.items()}
        write_text(out / "report.md", "\n".join([markdown(header, rows), "", *checks(best)]) + "\n")
    print((out / "report.md").read_text())


run = entry_point(lambda: typer.run(main))

if __name__ == "__main__":
    run()
