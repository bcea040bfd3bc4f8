"""The commands of README.md, one after the other, in an empty folder: they begin with the demo, and need nothing else. Then the script
of docs/python.md and the notebooks."""

import json
import re
import shlex
import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from doc_pages import ROOT, blocks, code
from PIL import Image

from docs.from_code import pictures
from docs.from_code.notebooks import BEGIN, END, PAGES, cells, shown
from rrr_oc import cli
from rrr_oc.commands import COMMANDS
from rrr_oc.commands.tour.truth import beside

REDUCED = {  # behind a command of the page
    "demo": ["--no-open"],
    "design": ["--starts", "1", "--motions", "0", "--intervals", "16", "--tolerance", "1e-2", "--cycle-times", "none"],
}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The folder, and the commands that ran in it."""
    folder = tmp_path_factory.mktemp("empty")
    lines = [line for line in code((ROOT / "README.md").read_text()) if line.startswith("rrr-oc ") and len(line.split()) > 1]
    commands = [words for words in map(shlex.split, dict.fromkeys(lines)) if words[1] in COMMANDS]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for words in commands:
            patch.setattr(sys, "argv", [*words, *REDUCED.get(words[1], [])])
            with pytest.raises(SystemExit) as ended:
                cli.main()
            assert ended.value.code in (0, None), words
    return folder, commands


def test_every_command_of_the_page_runs_after_the_demo(done):
    folder, commands = done
    assert [words[1] for words in commands] == ["demo", "init", "design", "diagnose", "export"]
    model = mujoco.MjModel.from_xml_path(str(folder / "arm/mujoco/arm.xml"))
    assert model.nv == 2


def test_the_demo_finds_what_is_hidden_and_nothing_else(done):
    """Against the truth: the names of both effects, the link, and 95 % intervals, of which one in six may miss."""
    folder, _ = done
    truth, found = (json.loads((folder / "demo" / name).read_text()) for name in ("truth.json", "diagnosis/diagnosis.json"))
    assert {(e["effect"], e["joint"]) for e in found["effects"]} == {(e["effect"], e["joint"]) for e in truth["effects"]}
    assert [one["link"] for one in found["link_findings"]] == [one["link"] for one in truth["links"]]
    verdicts = [row[-1] for row in beside(truth, found)]
    assert len(verdicts) == 6
    assert verdicts.count("yes") >= 5


def test_the_demo_designs_a_spring_and_shows_it(done):
    folder, _ = done
    found = json.loads((folder / "demo/design/summary.json").read_text())["configurations"]
    assert found["PEA"]["cost"] < 0.5 * found["SA"]["cost"]
    with Image.open(folder / "demo/design.gif") as picture:
        assert picture.n_frames > 20  # type: ignore[attr-defined]


def test_the_pictures_of_the_pages_are_those_of_the_demo(done, tmp_path):
    pictures.write(done[0] / "demo", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(pictures.MADE)
    for name in pictures.MADE:
        with Image.open(tmp_path / name) as now, Image.open(pictures.IMAGES / name) as then:
            assert np.allclose(now.size, then.size, rtol=0.02)


QUICK = '"starts": 1, "motions": 0, "intervals": 16, "cycle_times": "none", "tolerance": 1e-2'


def test_the_script_of_the_page_on_python_runs(done, monkeypatch, capsys):
    """A table of pandas is its columns and rows here."""
    monkeypatch.chdir(done[0])
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda rows, columns: (columns, rows)))
    (script,) = [text for language, text in blocks((ROOT / "docs" / "python.md").read_text()) if language == "python"]
    exec(compile(script, "docs/python.md", "exec"), {"__name__": "__main__"})
    said = capsys.readouterr().out
    assert "lacks cable harness of elbow" in said
    assert "'elbow', 'rest', 17." in said  # in degrees
    assert (done[0] / "prediction.png").stat().st_size > 10_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_notebooks_run(page, done, monkeypatch):
    """Each block has at most ten lines, and shows something, in the page as well."""
    monkeypatch.chdir(done[0])
    text = page.read_text()
    codes = [code.replace('"starts": 4, "motions": 0, "cycle_times": "none", "tolerance": 1e-3', QUICK) for code in cells(text)]
    assert text.count(BEGIN) == text.count(END) == len(codes)
    assert all(code.count("\n") <= 10 for code in codes)
    assert sum(code.count("rrr_oc.design(") for code in codes) == sum(code.count(QUICK) for code in codes)
    said = list(shown(codes))
    assert all(printed or value is not None for printed, value in said)
    printed = "".join(printed for printed, _ in said)
    values = [value for _, value in said if value is not None]
    if page.stem == "recordings":
        assert "cable harness" in values[0]._repr_html_()
    elif page.stem == "plain_mujoco":
        assert len(set(printed.splitlines())) == 9  # all arms differ
    elif page.stem == "payload_sweep":
        costs = [[float(x) for x in re.findall(r"[:,] ([\d.]+)", line)[:2]] for line in printed.splitlines()]
        assert all(sprung < 0.5 * stiff for stiff, sprung in costs)
        assert costs[0][0] < costs[1][0] < costs[2][0]  # the heavier, the more
    for value in values:
        if hasattr(value, "_repr_png_"):
            assert value._repr_png_().startswith(b"\x89PNG")
