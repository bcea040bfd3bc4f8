"""Models that recordings do not tell from the reported one: as good on these recordings, read back as written, and told apart by a file."""

import json
from dataclasses import replace

import chains
import numpy as np
import pytest
from recorded import Plant, as_set, record

from rrr_oc.calibration.calibrated_model import CalibratedModel, Estimate, Term
from rrr_oc.calibration.model_file import load_model, save_model
from rrr_oc.codesign.posterior.members import members, moved
from rrr_oc.diagnosis import mismatch
from rrr_oc.diagnosis.alternatives import Exchange, alternatives
from rrr_oc.diagnosis.procedure import diagnose, ready
from rrr_oc.diagnosis.result import Diagnosis
from rrr_oc.effects.priors import Priors
from rrr_oc.effects.transmission.joint_elasticity import JointElasticity
from rrr_oc.errors import UserError
from rrr_oc.report.diagnosis_report import write_diagnosis

STIFFNESS, REST = 6.0, 3.0  # of the hidden spring [Nm/rad], [rad]


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> tuple[Diagnosis, CalibratedModel]:
    """A diagnosis of an arm of two joints with a spring at joint 2 that is always taut, and its file."""
    folder, ones, rng = tmp_path_factory.mktemp("diagnosis"), np.ones(2), np.random.default_rng(5)
    (folder / "arm.urdf").write_text(chains.arm(2))
    plant = Plant(folder / "arm.urdf", ones, ones, 0.1 * ones)
    made = [record(plant, f"{i}.csv", rng, 8.0, 0.003) for i in range(3)]
    pull = [np.array([0 * r.q[1], STIFFNESS * (REST - r.q[1])]) for r in made]
    diagnosis = diagnose(as_set(plant, [replace(r, tau=r.tau - p) for r, p in zip(made, pull, strict=True)]))
    write_diagnosis(diagnosis, folder)
    return diagnosis, load_model(folder / "model.json")


def error(model: CalibratedModel, recordings) -> np.ndarray:
    """Rms of what a model leaves of the torques, (n,) [Nm]."""
    left = [recordings.output_torque(r) - model.predicted_torque(r) for r in recordings.recordings]
    return np.sqrt(np.mean(np.concatenate(left, axis=1) ** 2, axis=1))


def test_an_offset_beside_a_spring_may_be_its_pretension(found):
    """The recordings show a spring that is always taut: its equilibrium, and the zero of the torque sensor, are not told apart."""
    diagnosis, read = found
    names = {f.term.effect.name: f.term for f in diagnosis.findings}
    assert "torque_offset" in names
    other = next(a for a in read.alternatives if "torque_offset" in a.effects)
    assert "with another equilibrium in the place of torque_offset of j2" in other.says
    assert [t.effect.name for t in other.model.terms if t.effect.name == "torque_offset"] == []
    (spring,) = (t for t in other.model.terms if t.effect.side == "link")
    stiffness, rest = spring.values
    assert (stiffness, rest) == pytest.approx((STIFFNESS, REST), rel=0.01)  # as it was hidden; noise of 0.003
    np.testing.assert_allclose(error(other.model, diagnosis.recordings), error(read, diagnosis.recordings), rtol=0.01)
    # the load torque, which the offset is none of, differs by all of it
    apart = other.model.torques(diagnosis.recordings.recordings[0])[1] - read.torques(diagnosis.recordings.recordings[0])[1]
    assert np.abs(apart[1]).min() == pytest.approx(abs(names["torque_offset"].values[0]), rel=0.02)


def test_what_does_nothing_stands_for_nothing(found):
    """A torque of 0 needs no spring in its place, and a gear that is rigid is in no model: of their sizes nothing can be said."""
    told = found[0].model
    _, fitter, _, plain = ready(found[0].recordings, Priors())
    offset = next(t for t in told.terms if t.effect.name == "torque_offset")
    terms = tuple(replace(offset, estimates=(Estimate(0.0),)) if t is offset else t for t in told.terms)
    nothing = replace(told, terms=terms, alternatives=())
    begin, failed = fitter.fit(plain, fitter.data.links.none), dict[str, str]()
    effect = JointElasticity((1,))
    rigid = Term(effect, tuple(Estimate(x) for x in (1e9, 0.002)))
    gear = fitter.fit(replace(begin.model, terms=(*begin.model.terms, rigid)), begin.links, begin.posterior, steps=1)
    exchange = Exchange(gear, (("joint_elasticity", (1,)),), ())
    assert alternatives(fitter, [exchange], nothing, replace(begin, base=len(terms)), failed) == ()
    assert failed == {}


def test_the_file_holds_what_is_not_known(found):
    """The spread of each effect's parameters is what their standard errors say, and models come back as they were written."""
    diagnosis, read = found
    every = [(m, *(a.model for a in m.alternatives)) for m in (diagnosis.model, read)]
    for one, other in zip(*every, strict=True):
        assert one.spread is not None
        assert other.spread is not None
        np.testing.assert_allclose(other.spread, one.spread, rtol=1e-5)
        std = [e.std for t in other.terms for e in t.estimates]
        own = np.sqrt(np.sum(other.spread**2, axis=1))[: len(std)]
        pairs = [(a, b) for a, b in zip(std, own, strict=True) if a is not None]
        np.testing.assert_allclose(*np.transpose(pairs), rtol=1e-3)
        assert [t.effect for t in other.terms] == [t.effect for t in one.terms]
        np.testing.assert_allclose(other.robot.inertial, one.robot.inertial)
    assert [(a.says, a.effects, a.decided_by) for a in read.alternatives] == [
        (a.says, a.effects, a.decided_by) for a in diagnosis.model.alternatives
    ]


def test_what_is_far_above_noise_is_unexplained(found):
    """Of residuals of 1, 2.9 and 5 times the noise of 0.1 Nm the last one, less the noise itself."""
    left = mismatch.unexplained(np.array([1.0, 2.9, 5.0]), np.full(3, 0.1))
    np.testing.assert_allclose(left, [0, 0, 0.1 * np.sqrt(24)])
    diagnosis, read = found
    np.testing.assert_array_equal(read.unexplained, diagnosis.model.unexplained)
    assert read.unexplained.tolist() == [0.0, 0.0]  # a spring explains all


def test_draws_predict_the_recordings(found):
    """What the recordings leave open changes what they show by no more than their noise, 0.003 of the torque."""
    diagnosis, read = found
    recordings, plain = diagnosis.recordings, error(read, diagnosis.recordings)
    assert read.spread is not None
    for way in read.spread.T:
        assert np.all(error(moved(read, way), recordings) < 1.05 * plain)


def test_an_older_file_is_read(found, tmp_path):
    folder = tmp_path / "model.json"
    save_model(found[1], folder)
    content = json.loads(folder.read_text())
    del content["spread"], content["alternatives"], content["unexplained"]
    folder.write_text(json.dumps(content))
    older = load_model(folder)
    assert older.spread is older.unexplained is None
    assert older.alternatives == ()
    assert members(older)[0].draws == ()


def test_a_spread_of_another_size_is_refused(found, tmp_path):
    folder = tmp_path / "model.json"
    save_model(found[1], folder)
    content = json.loads(folder.read_text())
    content["alternatives"][0]["spread"][1] = [1.0]
    folder.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"alternatives\[0\].spread\[1\]: found 1 numbers; [0-9]{2} are required"):
        load_model(folder)
