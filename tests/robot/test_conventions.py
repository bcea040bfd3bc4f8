"""docs/conventions.md against Pinocchio alone: angles of start and release, holding torques, and the signs that the page states."""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "conventions.md").read_text()
ROWS = re.findall(r"^\| x = ([\d.]+) m, z = ([\d.]+) m .*? \| (.*?) \| (.*?) \| (.*?), (.*?) \| (.*?), (.*?) \|$", TEXT, re.M)


def arm(payload: float = 0.0) -> tuple[pin.Model, pin.Data]:  # type: ignore[name-defined]
    model = pin.buildModelFromUrdf(str(ROOT / "rrr_oc" / "urdf" / "rrr.urdf"))
    model.appendBodyToJoint(3, pin.Inertia(payload, np.zeros(3), np.zeros((3, 3))), pin.SE3(np.eye(3), np.array([0.3, 0, 0])))
    return model, model.createData()


def tool(q: np.ndarray) -> np.ndarray:
    model, data = arm()
    pin.forwardKinematics(model, data, q)
    return data.oMi[3].act(np.array([0.3, 0, 0]))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"x={row[0]}")
def test_the_table_of_poses(row):
    """Both links are 0.3 m long and the tool is as high as joint 2, so that cos q_2 = x / 0.6 m and q_3 = −2 q_2."""
    x, z, q2, q3, *torques = (float(cell.replace("−", "-")) for cell in row)
    q = np.arccos(x / 0.6) * np.array([0, 1, -2])
    np.testing.assert_allclose(tool(q), [x, 0, z], atol=1e-12)
    np.testing.assert_allclose([q2, q3], np.degrees(q[1:]), atol=0.0051)  # the digits shown
    for payload, shown in ((5.0, torques[:2]), (0.0, torques[2:])):
        model, data = arm(payload)
        np.testing.assert_allclose(shown, pin.computeGeneralizedGravity(model, data, q)[1:], atol=5.1e-4)  # the digits shown
    assert min(torques) > 0  # a positive torque holds the arm up


def test_signs_and_zero_pose():
    assert len(ROWS) == 2
    np.testing.assert_allclose(tool(np.zeros(3)), [0.6, 0, 0.07], atol=1e-12)
    assert tool(np.array([0, 0.1, 0]))[2] > 0.07
    assert tool(np.array([0.1, 0, 0]))[1] > 0  # anticlockwise seen from above
    elbow_up = np.radians([0, 48.19, -96.38])
    model, data = arm()
    pin.forwardKinematics(model, data, elbow_up)
    assert data.oMi[3].translation[2] > 0.07 + 0.2
