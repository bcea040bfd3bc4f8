"""The commands of README.md, one after the other, in an empty folder: they begin with the demo, and need nothing else. Then the scripts
of docs/python.md."""

import json
import shlex
import sys
from types import SimpleNamespace

import mujoco
import pytest
from doc_pages import ROOT, blocks, code
from PIL import Image

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


QUICK = 'starts=1, motions=0, intervals=16, tolerance=1e-2, cycle_times="none", quiet=True'


def test_the_scripts_of_the_page_on_python_run(done, monkeypatch, capsys):
    """Each of at most ten lines; a table of pandas is its columns and rows here."""
    monkeypatch.chdir(done[0])
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda rows, columns: (columns, rows)))
    scripts = [text for language, text in blocks((ROOT / "docs" / "python.md").read_text()) if language == "python"]
    assert [len(text.split("\n")) <= 11 for text in scripts] == [True] * 3
    said = []
    for text in scripts:
        assert text.count("starts=6") == text.count("rrr_oc.design")
        exec(compile(text.replace("starts=6", QUICK), "docs/python.md", "exec"), {"__name__": "__main__"})
        said.append(capsys.readouterr().out)
    costs = [[float(x) for x in line.split()[2:4]] for line in said[0].splitlines()]
    assert len(costs) == 3
    assert all(sprung < 0.5 * stiff for stiff, sprung in costs)
    assert costs[0][0] < costs[1][0] < costs[2][0]  # the heavier, the more
    assert "lacks cable harness of elbow" in said[1]
    assert "'elbow', 'rest', 17." in said[1]  # in degrees
    assert (done[0] / "prediction.png").stat().st_size > 10_000
    assert "arm.xml" in said[2]
