# pyright: reportAttributeAccessIssue=false
"""Effects in files of their own, outside the package: seen wherever those of the package are, without a change elsewhere."""

import ast
import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import chains
import mujoco
import numpy as np
import pytest
import test_effects as catalogue_wide
from recorded import Plant, as_set, multisine, record
from typer.testing import CliRunner

import rrr_oc
from rrr_oc.calibration.calibrate import calibrate, fit
from rrr_oc.calibration.calibrated_model import nominal_term
from rrr_oc.calibration.inverse_dynamics import plain_model
from rrr_oc.calibration.response import Response
from rrr_oc.codesign.catalogue import load_catalogue
from rrr_oc.codesign.design_problem import CoDesign
from rrr_oc.codesign.search.local_optima import transcribed
from rrr_oc.codesign.search.proposals import SearchOptions, motion_guess
from rrr_oc.codesign.springs import offered, spring_bounds
from rrr_oc.codesign.task import load_task
from rrr_oc.commands import app
from rrr_oc.diagnosis.procedure import diagnose
from rrr_oc.effects import CATALOGUE, register
from rrr_oc.errors import UserError
from rrr_oc.model.symbolic_model import Model
from rrr_oc.optimal_control.solver import Solver
from rrr_oc.recordings.reader import load_recordings
from rrr_oc.recordings.writer import save_recordings
from rrr_oc.robot.robot import load_robot
from rrr_oc.simulation.engine_model import twin

BAND = '''
"""A rubber band that gets stiffer as it is stretched."""

import numpy as np

from rrr_oc.effects import DesignSpring, ListedSpring, register
from rrr_oc.effects.design_form import DesignForm, Quantity
from rrr_oc.effects.springs import Listing
from rrr_oc.robot.parameters import Parameter


@register
class RubberBand(ListedSpring, DesignSpring):
    """tau = -stiffness (q - rest)^3."""

    name = "rubber_band"
    equation = "tau = -stiffness (q - rest)^3"
    parameters = (Parameter("stiffness", "Nm/rad³", 0.0, lower=0.0), Parameter("rest", "rad", 0.0))
    amplitudes = ("stiffness",)
    listing = Listing("bands", ("stiffness_Nm_per_rad3", "rest_rad"))
    design = DesignForm(
        "BAND",
        "rubber bands along joints",
        (Quantity("k_r", "stiffness_Nm_per_rad3", "Nm/rad³", lowest=0.0), Quantity("q_r", "rest_deg", "rad", np.pi / 180, free=True)),
        shop="rubber_bands",
    )

    def torque(self, signals, theta, width):
        return (-theta["stiffness"] * (signals.q[self.joints[0]] - theta["rest"]) ** 3,)

    def energy(self, signals, theta, width):
        return theta["stiffness"] * (signals.q[self.joints[0]] - theta["rest"]) ** 4 / 4

    def moved(self, theta, offset):
        return {**theta, "rest": theta["rest"] + offset}

    @classmethod
    def shapes(cls, view, joints):
        low, high = view.low[joints[0]], view.high[joints[0]]
        return [{"rest": float(low + share * (high - low))} for share in (0.2, 0.4, 0.6, 0.8)]
'''
TAR = '''
"""Friction in proportion to the cube of speed, in every drive."""

from rrr_oc.effects import Effect, register
from rrr_oc.robot.parameters import Parameter


@register
class Tar(Effect):
    """tau = -thickness dq^3."""

    name = "tar"
    equation = "tau = -thickness dq^3"
    parameters = (Parameter("thickness", "Nm s³/rad³", 0.0, lower=0.0),)
    side = "drive"
    provides = "friction"
    role = "plain"

    def torque(self, signals, theta, width):
        return (-theta["thickness"] * signals.dq[self.joints[0]] ** 3,)
'''


@pytest.fixture
def added(tmp_path, monkeypatch):
    """Adds the effect of a file to the catalogue for one test."""
    before, modules = dict(CATALOGUE), []

    def add(name: str, text: str):
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        modules.append(name)
        importlib.import_module(name)
        (kind,) = (kind for key, kind in CATALOGUE.items() if key not in before)
        return kind

    yield add
    CATALOGUE.clear()
    CATALOGUE.update(before)
    for name in modules:
        del sys.modules[name]


@pytest.fixture
def band(added):
    return added("made_up_band", BAND)


def test_it_is_part_of_co_designs(band, tmp_path):
    """By its label, alone and with others; its bounds are kept, and it lowers the cost."""
    one, two = ["SA", "PEA", "BAND", "BPEA"], ["PEA+BAND", "PEA+BPEA", "BAND+BPEA"]
    task = load_task("paper")
    entry = {"effect": "rubber_band", "joint": "joint2", "stiffness_Nm_per_rad3": [0, 3], "rest_deg": [-90, 180]}
    task = replace(task, springs=(*task.springs, entry))
    assert list(offered(task)) == [*one, *two, "PEA+BAND+BPEA"]
    options, costs = SearchOptions(coarse=10), {}
    for name in ("SA", "BAND"):
        design = CoDesign(task, spring_bounds(task, name))
        guess = motion_guess(design, np.array([1.0, 1.5])[: design.problem.p_lower.size], [2.0, 2.0])
        solution = Solver(transcribed(design, options, 10)).solve(guess, design.data(0.01))
        costs[name] = solution.cost
    assert costs["BAND"] < 0.8 * costs["SA"]
    hardware = design.hardware(solution.parameters)
    assert set(hardware) == {"k_r2", "q_r2"}
    assert 0 <= hardware["k_r2"] <= 3 + 1e-6
    held = design.with_fixed({"k_r2": 1.25}, ("q_r2",))
    np.testing.assert_allclose([held.problem.p_lower, held.problem.p_upper], [[1.25, -np.pi / 2], [1.25, np.pi]])
    with pytest.raises(UserError, match="stiffness_Nm_per_rad3 must be 0 or more, got -1 … 3"):
        spring_bounds(replace(task, springs=({**entry, "stiffness_Nm_per_rad3": [-1, 3]},)), "BAND")
    shop = tmp_path / "shop.json"
    shop.write_text('{"format": "rrr_oc-catalogue/1", "rubber_bands": {"joint2": [2, 1]}}')
    assert load_catalogue(shop).lists["BAND"] == {"joint2": (1.0, 2.0)}


def test_it_acts_in_the_engine(band):
    robot, theta = load_robot("rrr"), np.array([3.0, 0.4])
    engine = twin(Model(robot, robot.tool, (band((1,)),)), theta)
    d = mujoco.MjData(engine.mj)
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        d.qpos[:] = q
        with engine.effects():
            mujoco.mj_forward(engine.mj, d)
        np.testing.assert_allclose(d.qfrc_passive, [0, -3.0 * (q[1] - 0.4) ** 3, 0], atol=1e-12)  # rounding


@pytest.fixture
def stretched(tmp_path):
    """Recordings of one joint with a rubber band of 12 Nm/rad³ that rests at 0.2 rad, which nobody listed."""
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(chains.arm(1))
    plant, rng, made = Plant(urdf, np.ones(1), np.ones(1), 0.1 * np.ones(1)), np.random.default_rng(3), []
    for i in range(4):
        motion = multisine(1, np.arange(1500) / 100, rng)
        r = record(plant, f"{i}.csv", rng, 15.0, 0.005, motion)
        made.append(replace(r, tau=r.tau + 12.0 * (motion[0] - 0.2) ** 3))
    return as_set(plant, made)


def test_it_is_calibrated(band, stretched):
    start = plain_model(stretched)
    term = nominal_term(band((0,))).with_values(np.array([5.0, 0.1]))
    fitted = fit(stretched, replace(start, terms=(*start.terms, term)))
    np.testing.assert_allclose(fitted.terms[-1].values, [12.0, 0.2], rtol=0.05)


def test_it_is_diagnosed(band, stretched):
    (finding,) = diagnose(stretched).findings
    assert finding.term.effect == band((0,))
    np.testing.assert_allclose(finding.term.values, [12.0, 0.2], rtol=0.05)


def test_recordings_list_it(band, stretched, tmp_path):
    spring = band((0,)), {"stiffness": 12.0, "rest": 0.2}
    listed = replace(stretched, recordings=tuple(replace(r, springs=(spring,)) for r in stretched.recordings))
    save_recordings(listed, tmp_path / "set")
    assert load_recordings(tmp_path / "set").recordings[0].springs == (spring,)


def test_the_command_shows_it(band):
    result = CliRunner().invoke(app, ["effects"], terminal_width=200)
    assert result.exit_code == 0
    for text in ("rubber_band", "parallel_spring", "[Nm/rad³]", *(name[:12] for name in CATALOGUE)):
        assert text in result.output


@pytest.mark.parametrize(
    "test",
    [
        catalogue_wide.test_numpy_and_casadi_agree,
        catalogue_wide.test_derivatives_against_differences,
        catalogue_wide.test_what_stores_energy_gives_it_back,
    ],
    ids=lambda test: test.__name__,
)
def test_the_catalogue_wide_tests_hold_for_it(band, test):
    test(band.name)


def test_an_effect_of_every_model_is_in_every_model(added, stretched):
    """A new part of plain calibration, by least squares and in the box of the simulated response."""
    tar = added("made_up_tar", TAR)
    thick = replace(
        stretched,
        recordings=tuple(replace(r, tau=r.tau - 12.0 * (r.q - 0.2) ** 3 + 0.4 * r.dq**3) for r in stretched.recordings),
    )
    model = calibrate(thick)
    (term,) = (t for t in model.terms if t.effect == tar((0,)))
    assert term.values == pytest.approx(0.4, rel=0.1)
    prompt = replace(model, terms=model.prompt_terms)
    assert Response(thick, prompt).box.shape == (4,)


def test_two_effects_of_one_name_are_turned_away(band):
    with pytest.raises(UserError, match="two effects of the name 'rubber_band'"):
        register(type("Other", (band,), {}))


def test_installed_packages_add_effects_in_every_process(tmp_path):
    (tmp_path / "made_up_band.py").write_text(BAND)
    info = tmp_path / "bands-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bands\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rrr_oc.effects]\nband = made_up_band\n")
    paths = os.pathsep.join([str(tmp_path), str(Path(rrr_oc.__file__).parents[1])])
    command = "from rrr_oc.effects import CATALOGUE; print(*CATALOGUE)"
    found = subprocess.run(
        [sys.executable, "-c", command], env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=True
    )
    assert "rubber_band" in found.stdout.split()


ENGINE_FIELDS = {"armature"}  # a name of MuJoCo's, too


def test_nothing_outside_knows_an_effect_by_name_or_class():
    """No import of an effect's file, no string that is an effect's name; docstrings may speak of effects."""
    package, wrong = Path(rrr_oc.__file__).parent, {}
    files, classes = ({getattr(kind, name) for kind in CATALOGUE.values()} for name in ("__module__", "__name__"))
    for path in (p for p in sorted(package.rglob("*.py")) if p.relative_to(package).parts[0] != "effects"):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        imports = {node.module for node in nodes if isinstance(node, ast.ImportFrom)}
        imports |= {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        strings = {node.value for node in nodes if isinstance(node, ast.Constant)} & (set(CATALOGUE) - ENGINE_FIELDS)
        if found := (imports & files) | strings | ({node.id for node in nodes if isinstance(node, ast.Name)} & classes):
            wrong[str(path.relative_to(package))] = sorted(found)
    assert wrong == {}
