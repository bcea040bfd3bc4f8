"""The command that judges known cases of the diagnosis: one case, as its user runs it, and its table in the documentation."""

import re
from pathlib import Path

from validation import known_misses as command

ROOT = Path(__file__).resolve().parents[2]


def test_a_case_is_judged_once(tmp_path, capsys):
    command.main(tmp_path, "width-0.1", 300)
    (row,) = re.findall(r"^\| width-0\.1 \|.*$", (tmp_path / "known_misses.md").read_text(), re.M)
    assert re.search(r"\| [\d.]+ rad/s, [\d.]+ rad/s; amplitude [\d.]+ Nm \| (yes|no) \| [\d.]+ \|$", row)
    made = (tmp_path / "width-0.1.json").stat().st_mtime_ns
    command.main(tmp_path, "width-0.1", 300)
    assert (tmp_path / "width-0.1.json").stat().st_mtime_ns == made


def test_a_case_that_takes_too_long_is_said_to(tmp_path, capsys):
    command.main(tmp_path, "cushion", 1)
    assert "| ended after 1 s | no | 1.0 |" in capsys.readouterr().out


def test_the_documentation_has_every_case():
    shown = re.findall(r"^\| ([\w.-]+) \| .* \| (?:yes|no) \| [\d.]+ \|$", (ROOT / "docs" / "validation.md").read_text(), re.M)
    assert shown == list(command.CASES)
