"""Plants and cases that the tests of the diagnosis share."""

import json
from pathlib import Path

import chains
import numpy as np
import pytest
from recorded import Plant

from validation.concealed.build import build
from validation.concealed.cases import Case, Concealed
from validation.concealed.write import write_case


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """Folder of a short case of the plant, made once for each declaration."""
    folder, cases = tmp_path_factory.mktemp("cases"), {}

    def make(key: str, robot: str, *concealed: Concealed) -> tuple[Path, dict]:
        if key not in cases:
            case = Case(key, "test", 11, robot, concealed, short=True)
            (folder / "sealed").mkdir(exist_ok=True)
            write_case(build(case), folder)
            truth = json.loads((folder / "sealed" / f"{case.id}.json").read_text())
            cases[key] = (folder / case.id, truth)
        return cases[key]

    return make


@pytest.fixture
def planar(tmp_path):
    """Makes a plant of so many joints whose axes are horizontal and parallel."""

    def make(joints: int) -> Plant:
        urdf = tmp_path / "arm.urdf"
        urdf.write_text(chains.arm(joints))
        return Plant(urdf, np.ones(joints), np.ones(joints), 0.1 * np.ones(joints))

    return make
