"""Least squares on columns of torque: how much of a torque they explain beside those of plain friction and rotors."""

import numpy as np


def plain_columns(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Dry friction, viscous friction and rotor of each joint, (n, K, 3 n)."""
    n, count = v.shape
    result = np.zeros((n, count, 3 * n))
    for j in range(n):
        result[j, :, 3 * j : 3 * j + 3] = np.column_stack([np.tanh(v[j] / 0.02), v[j], a[j]])
    return result


def explained(torque: np.ndarray, columns: np.ndarray, beside: np.ndarray) -> float:
    """Share of the squares that columns (n, K, p), which contain those `beside`, explain of what these leave of a torque (n, K)."""
    left, less = (rest(torque, x) for x in (beside, columns))
    return float(1 - less / left) if left > 1e-12 * max(float(np.sum(torque**2)), 1e-30) else 0.0


def rest(torque: np.ndarray, columns: np.ndarray) -> float:
    """Sum of squares that columns (n, K, p) leave of a torque (n, K)."""
    A, y = columns.reshape(-1, columns.shape[-1]), torque.ravel()
    A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-12)
    return float(np.sum((y - A @ np.linalg.lstsq(A, y, rcond=1e-9)[0]) ** 2))


def hats(x: np.ndarray, count: int = 40) -> np.ndarray:
    """Piecewise linear functions over the range of a row (K,), (K, count)."""
    nodes = np.linspace(x.min(), x.max() + 1e-9, count)
    return np.maximum(1 - np.abs(x[:, None] - nodes) / (nodes[1] - nodes[0]), 0)


def flexible(variables: list[str], x: dict[str, np.ndarray], joints: list[str], j: int) -> np.ndarray:
    """Functions of variables as a diagnosis names them, one after the other, and times signs of speeds that are among them, (K, p)."""

    def row(name: str) -> np.ndarray:
        kind, _, joint = name.removeprefix("sign(").removesuffix(")").partition("_")
        at = joints.index(joint) if joint in joints else j
        plain = {"q": "q", "dq": "v", "ddq": "a"}.get(kind, "t" if name == "time" else "load")
        return x[plain] if plain == "t" else x[plain][at]

    flat = [part.strip() for name in variables for part in name.replace("·", "*").split("*")]
    signs = [np.tanh(row(name) / 0.01)[:, None] for name in flat if name.startswith("sign(")]
    known = [
        name for name in flat if not name.startswith("sign(") and name.partition("_")[0] in ("q", "dq", "ddq", "time", "load")
    ]
    blocks = [np.ones((x["t"].size, 1)), *(hats(row(name)) for name in dict.fromkeys(known))]
    return np.concatenate([*blocks, *(sign * block for sign in signs for block in blocks)], axis=1)


def law_columns(name: str, at: list[int], x: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Columns of a law of the catalogue at joints, (n, K, p), for each of several shapes; none of a law that has no such form."""
    j = at[0]
    q, v, load, tau, t = x["q"][j], x["v"][j], x["load"][j], x["tau"][j], x["t"]
    s, one = np.tanh(v / 0.01), np.ones_like(q)
    single = {
        "torque_offset": lambda: [[one]],
        "torque_gain": lambda: [[tau]],
        "coulomb_asymmetry": lambda: [[s * s]],
        "viscous_asymmetry": lambda: [[v * s]],
        "quadratic_drag": lambda: [[v * np.abs(v)]],
        "load_dependent_friction": lambda: [[np.abs(load) * s], [np.abs(tau) * s]],
        "cable_harness": lambda: [[q, one], [q, one, q**2, q**3]],
        "parallel_spring": lambda: [
            [np.maximum(way * (q - e), 0)] for e in np.quantile(q, np.linspace(0, 1, 15)) for way in (-1, 1)
        ],
        "stribeck": lambda: [[np.exp(-((v / w) ** 2)) * s] for w in (0.03, 0.06, 0.12, 0.25, 0.5)],
        "friction_drift": lambda: [[s * np.exp(-t / c), v * np.exp(-t / c)] for c in (2, 4, 8, 16)],
        "torque_ripple": lambda: [[np.cos(k * q), np.sin(k * q)] for k in range(1, 31)],
        "position_dependent_friction": lambda: [[s * np.cos(k * q), s * np.sin(k * q)] for k in range(1, 9)],
    }
    shapes = []
    for rows in single.get(name, list)():
        columns = np.zeros((*x["q"].shape, len(rows)))
        columns[j] = np.column_stack(rows)
        shapes.append(columns)
    if name == "two_sided_biarticular_spring":
        both = np.column_stack([x["q"][at[0]], x["q"][at[-1]], one])
        columns = np.zeros((*x["q"].shape, 6))
        columns[at[0], :, :3], columns[at[-1], :, 3:] = both, both
        shapes.append(columns)
    return shapes
