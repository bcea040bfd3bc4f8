"""Made-up robots for the tests: URDFs of serial chains with skew axes, turned frames and turned inertial frames."""

from collections.abc import Mapping, Sequence

import numpy as np


def link(
    name: str, mass: float = 1.0, moments: Sequence[float] = (0.02, 0.03, 0.04), xyz: str = "0.1 0 0", rpy: str = "0 0 0"
) -> str:
    """A link; without an <inertial> where the mass is 0."""
    if mass == 0:
        return f'  <link name="{name}"/>\n'
    ixx, iyy, izz = moments
    return (
        f'  <link name="{name}">\n    <inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass!r}"/>\n'
        f'      <inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/></inertial>\n  </link>\n'
    )


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str | None = None, **attributes: str) -> str:
    """A joint; `xyz`, `rpy` and `axis` as in a URDF, `inside` replaces its <limit>."""
    origin = f'<origin xyz="{attributes.get("xyz", "0.3 0 0")}" rpy="{attributes.get("rpy", "0 0 0")}"/>'
    limit = '<limit lower="-2" upper="2" effort="50" velocity="3"/>' if inside is None else inside
    axis = f'<axis xyz="{attributes.get("axis", "0 -1 0")}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'  <joint name="{name}" type="{kind}">\n    {ends}{origin}{axis}{limit}\n  </joint>\n'


def robot(*parts: str, name: str = "made_up") -> str:
    """The URDF of links and joints."""
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n{"".join(parts)}</robot>\n'


def arm(joints: int = 3, kinds: Mapping[int, str] | None = None) -> str:
    """A plain arm of equal links base, l1, …, and joints j1, …, whose kinds may be changed by number."""
    kinds = kinds or {}
    links = ["base", *[f"l{i + 1}" for i in range(joints)]]
    parts = [link("base", 0), *[link(name) for name in links[1:]]]
    parts += [joint(f"j{i + 1}", links[i], links[i + 1], kinds.get(i + 1, "revolute")) for i in range(joints)]
    return robot(*parts)


def random_chain(seed: int, joints: int) -> str:
    """A chain whose every number is random: skew axes, frames and inertial frames turned about all axes, and a tool frame.

    Moments of inertia keep the triangle inequality: they are sums of squares of a box's sides.
    """
    rng = np.random.default_rng(seed)

    def triple(scale: float) -> str:
        return " ".join(repr(float(v)) for v in scale * rng.normal(size=3))

    parts, parent = [link("base", 0)], "base"
    for i in range(joints):
        name, mass = f"l{i + 1}", float(rng.uniform(0.5, 4))
        sides = rng.uniform(0.05, 0.4, 3) ** 2
        moments = [float(mass / 12 * (sides.sum() - side)) for side in sides]
        parts.append(link(name, mass, moments, triple(0.1), triple(1.0)))
        parts.append(joint(f"j{i + 1}", parent, name, xyz=triple(0.2), rpy=triple(1.0), axis=triple(1.0)))
        parent = name
    parts += [link("tool", 0), joint("mount", parent, "tool", "fixed", "", xyz=triple(0.2), rpy=triple(1.0))]
    return robot(*parts, name=f"chain{joints}")
