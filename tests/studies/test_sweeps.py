"""Sweeps against Eq. 14 as printed and the authors' recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rrr_oc.errors import UserError
from rrr_oc.recordings.importers.prototype import import_prototype
from studies.paper.sweeps import PROTOTYPE_SPRINGS, PROTOTYPE_SWEEP, protocol, sweep

RAW = Path(__file__).resolve().parents[3] / "shared/recordings/rrr_prototype"


@pytest.mark.parametrize("direction", ["rising", "falling"])
def test_sweep_is_eq_14_and_its_derivatives(direction):
    """Joint 3 written out as printed; derivatives by central differences, whose error is of order step²."""
    plan = sweep(PROTOTYPE_SWEEP, direction)
    f0, f1 = (0.01, 0.1) if direction == "rising" else (0.1, 0.01)
    t = plan.t
    printed = -np.radians(135) * t / 60 * np.sin(2 * np.pi * (f0 * t + (f1 - f0) / (2 * 60) * t**2))
    np.testing.assert_allclose(plan.q[2], printed, atol=1e-13)
    h = 1e-4
    before, after = (PROTOTYPE_SWEEP.motion(t + s, direction) for s in (-h, h))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h), plan.dq, atol=1e-7)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), plan.ddq, atol=1e-7)
    np.testing.assert_array_equal(plan.q[:, 0], PROTOTYPE_SWEEP.centre)
    assert t[-1] == 60


@pytest.mark.skipif(not RAW.is_dir(), reason="the authors' recordings, which have no license, lie beside this repository only")
def test_sweeps_are_what_the_authors_recorded(tmp_path):
    recorded = import_prototype(RAW, tmp_path / "set").recordings
    planned = {(plan.file.startswith("falling"), float(plan.payload[0]), bool(plan.springs)): plan for plan in protocol()}
    assert len(planned) == len(recorded) == 8
    for r in recorded:
        plan = planned.pop((int(r.file[-6:-4]) <= 6, float(r.payload[0]), bool(r.springs)))
        q = np.array([np.interp(r.t, plan.t, row) for row in plan.q])
        assert np.degrees(np.sqrt(np.mean((r.q - q) ** 2, axis=1))).max() < 0.5  # tracking error of their controllers
        assert [(e.name, e.joints) for e, _ in r.springs] == [(e.name, e.joints) for e, _ in plan.springs]
    assert not planned


def test_protocol():
    plans = protocol(step=0.1)
    assert [p.file for p in plans] == [
        f"{direction}{payload}{springs}"
        for direction in ("rising", "falling")
        for payload in ("_payload", "")
        for springs in ("_springs", "")
    ]
    assert [p.payload[0] for p in plans] == [5.0, 5.0, 0.0, 0.0] * 2
    assert [p.springs for p in plans] == [PROTOTYPE_SPRINGS, ()] * 4
    assert PROTOTYPE_SPRINGS[0][1] == {"stiffness": 13.705, "equilibrium": pytest.approx(np.radians(110))}


def test_unusable_sweeps():
    with pytest.raises(UserError, match="rising or falling, got 'up'"):
        sweep(PROTOTYPE_SWEEP, "up")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="step"):
        sweep(PROTOTYPE_SWEEP, "rising", step=0.0)
    with pytest.raises(UserError, match="slow ≤ fast"):
        replace(PROTOTYPE_SWEEP, slow=np.ones(3))
