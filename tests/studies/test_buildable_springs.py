"""The study of springs that can be built: its problems, its table, and what it says to those who ask wrongly."""

import buildable_springs as study
import numpy as np
import pytest
from commands import run

from rrr_oc.codesign.search.proposals import SearchOptions
from rrr_oc.commands.output import Output


@pytest.fixture
def of(tmp_path) -> study.Run:
    return study.Run(tmp_path, np.radians(900), (3.0, 4.0), SearchOptions(), Output())


def test_its_motions_and_springs_have_limits(of):
    design = of.design("PEA")
    assert {kept.name for kept in design.task.kept(np.zeros(3))} == {"the floor"}
    assert design.orders[1].tolist() == [3, 3]  # the jerks are the controls
    assert {part.unit for part in design.limited_parts} == {"Nm", "rad", "J"}
    assert of.design(study.BALANCED).limited_parts == []
    assert [spring.effect.name for spring in of.design(study.BALANCED).springs][-1] == "biarticular_spring"


def test_the_table_says_what_is_saved_at_each_time(of):
    def told(motor: float) -> dict:
        return {"motor": motor, "E1": motor / 4, "work_J": 50.0}

    rigid = told(2000.0) | {"at": [told(2400.0), told(2000.0)]}
    sprung = told(1500.0) | {"at": [None, told(1000.0)]}
    table = study._report(of, {name: rigid if name == study.RIGID else sprung for name in study.ROWS})
    assert "| SA | 2000 | 2400 | 2000 |" in table
    assert "| PEA | 1500 (25 %) | – | 1000 (50 %) |" in table
    assert "| PEA+BPEA | 375 (25 %) | – | 250 (50 %) |" in table
    assert "| balanced at rest | 50.0 (0 %) | – | 50.0 (0 %) |" in table


def test_what_is_no_time_is_refused(monkeypatch, capsys, tmp_path):
    assert run(study, monkeypatch, "--cycle-times", "3,soon", "--out", str(tmp_path)) == 2
    assert "--cycle-times is '3,soon'; numbers of seconds, comma-separated, are required" in capsys.readouterr().err
