"""The page of a co-design study, made from its saved files alone: summary.json, the npz of each motion, and the points of the arm."""

from pathlib import Path

from rrr_oc.codesign.design_file import DesignFile
from rrr_oc.effects.words import joint_words
from rrr_oc.report import design_words as say
from rrr_oc.report.design_figures import ARM, design_figures, read_motions
from rrr_oc.report.design_report import sections
from rrr_oc.report.figures import Figure
from rrr_oc.report.pages.page import render
from rrr_oc.schema import read_json
from rrr_oc.storage import read_npz, write_text


def write_design_page(folder: Path) -> Path:
    """Write report.html from the files in the folder of a study; nothing is solved. Raises `UserError` where it cannot be written."""
    study = read_json(folder / "summary.json", DesignFile)
    arm = read_npz(folder / ARM) if (folder / ARM).is_file() else None
    write_text(folder / "report.html", design_page(study, design_figures(study, read_motions(folder, study), arm)))
    return folder / "report.html"


def design_page(study: DesignFile, figures: list[Figure]) -> str:
    """The page as HTML, with the content of summary.json and the figures of `design_figures`."""
    found = study.configurations
    best = say.best_of(found) or next(iter(found))
    choices = [("configuration", "Configuration", [(name, name) for name in found], best)]
    if not study.single:
        choices.append(("task", "Task", [(str(t), task.name) for t, task in enumerate(study.tasks)], "0"))
    choices.append(("joint", "Joint", [(str(j), joint_words(joint)) for j, joint in enumerate(study.moving)], "0"))
    return render(
        "design.html",
        figures,
        study=study,
        best=best,
        title=say.title(study),
        minimised=say.minimised(study),
        kinds=say.kinds_of_springs(found),
        verdict=say.verdict(study),
        cautions=say.cautions(study),
        sections=sections(study),
        choices=choices,
    )
