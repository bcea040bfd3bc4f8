# pyright: reportAttributeAccessIssue=false
"""A URDF that is a little off, as every drawing is: masses, centres and inertias of all links."""

import xml.etree.ElementTree as ET

import numpy as np

from validation.concealed.arms import Arm, reduced_model

MASS = (0.02, 0.05)  # relative error of a mass, either sign
CENTRE = (0.0015, 0.0045)  # length of the error of a centre [m], 3 mm on average
INERTIA = 0.05  # standard deviation of the relative error of an inertia


def perturbed(urdf: str, rng: np.random.Generator) -> str:
    """The URDF with every link's inertial parameters off; they remain those of a body that could exist.

    The second moments S = tr(I)/2 − I about the centre become A S Aᵀ with A = 1 + E, E small and symmetric, so that they stay
    positive semidefinite and the three inertias keep the triangle inequality.
    """
    root = ET.fromstring(urdf)
    for inertial in root.iter("inertial"):
        mass, origin, inertia = (inertial.find(tag) for tag in ("mass", "origin", "inertia"))
        if mass is None or inertia is None or float(mass.get("value", "0")) <= 0.0:
            continue
        mass.set("value", f"{float(mass.get('value', '0')) * (1 + rng.choice([-1, 1]) * rng.uniform(*MASS)):.8g}")
        if origin is None:
            origin = ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
        centre = np.array(origin.get("xyz", "0 0 0").split(), float)
        direction = rng.normal(size=3)
        centre += rng.uniform(*CENTRE) * direction / np.linalg.norm(direction)
        origin.set("xyz", " ".join(f"{x:.8g}" for x in centre))
        for name, value in entries(distorted(matrix(inertia), rng)).items():
            inertia.set(name, f"{value:.8g}")
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def matrix(inertia: ET.Element) -> np.ndarray:
    """(3, 3) [kg m²]."""
    xx, xy, xz, yy, yz, zz = (float(inertia.get(k, "0")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def entries(inertia: np.ndarray) -> dict[str, float]:
    return {f"i{'xyz'[i]}{'xyz'[k]}": float(inertia[i, k]) for i in range(3) for k in range(i, 3)}


def distorted(inertia: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another body's inertia (3, 3), about `INERTIA` off."""
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    error = rng.normal(0.0, INERTIA / 2, (3, 3))
    stretch = np.eye(3) + 0.5 * (error + error.T)
    second = stretch @ second @ stretch.T
    return np.trace(second) * np.eye(3) - second


def inertial_errors(arm: Arm) -> list[np.ndarray]:
    """True less stated, of each recorded joint's body: (mass, 3 first moments, 6 inertias) as Pinocchio orders them, about its frame."""
    assert arm.stated_urdf is not None
    stated = reduced_model(arm.stated_urdf, arm.joints)
    return [
        arm.model.inertias[j + 1].toDynamicParameters() - stated.inertias[j + 1].toDynamicParameters() for j in range(arm.n)
    ]
