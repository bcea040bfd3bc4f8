"""Searches of seconds, evolutionary and by gradients, that several tests run."""

from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.codesign.springs import spring_bounds
from rrr_oc.codesign.task import Task, load_task
from rrr_oc.optimal_control.refinement import Refinement
from studies.paper.evolution import Protocol

TASK = load_task("paper")
SMALL = Protocol("analytic", generations=150, population=12, every=3)
TIMES = ("core_s", "wall_s")
LABELS = {"preset": "paper", "experiment": "BPEA", "ends": "rest", "way": "evolution", "model": "analytic"}
OPTIONS = SearchOptions(
    starts=6, coarse=8, fine=12, widths=(0.01,), refinement=Refinement(1e-3, rounds=2), within=0.02, motions=0
)


def numbers(found: dict) -> dict:
    """Everything but times, which differ from run to run."""
    return {k: v for k, v in found.items() if k not in TIMES}


def design_of(configuration: str, task: Task = TASK) -> CoDesign:
    return CoDesign(task, spring_bounds(task, configuration))


PEA = design_of("PEA")
