"""Motions as moving pictures: the arm with its payload, and the torques of its joints beside it."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter

from rrr_oc.errors import UserError
from rrr_oc.report.figures import COLOURS, FOOTER, plt
from rrr_oc.robot.rigid_body import rigid_body
from rrr_oc.robot.robot import Robot, ToolPoint
from rrr_oc.storage import new_file

FRAMES_PER_SECOND = 20  # of the picture
WRITERS = {".gif": PillowWriter, ".mp4": FFMpegWriter}
HEAVY = 2.0  # [kg] of a payload drawn at the usual size of a joint; its area grows in proportion


@dataclass(frozen=True)
class Scene:
    """What is shown.

    Attributes:
        robot, tool: The arm, and where it holds the payload.
        t: Time [s], (K,).
        q: Positions of all joints [rad], (n, K).
        torques: Name and values [Nm], (m, K), of each kind of torque that is drawn.
        labels: The m joints that these belong to.
        payload: Mass held at each instant [kg], (K,).
        title: Above the picture.
    """

    robot: Robot
    tool: ToolPoint
    t: np.ndarray
    q: np.ndarray
    torques: dict[str, np.ndarray]
    labels: tuple[str, ...]
    payload: np.ndarray
    title: str


def animate(scene: Scene, path: Path) -> None:
    """Write a scene as GIF, or as MP4 where ffmpeg is installed, in real time.

    Raises `UserError` for another ending of the name, and where ffmpeg is missing.
    """
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise UserError(f"{path}: allowed are names that end in {' or '.join(WRITERS)}")
    if not writer.isAvailable():
        raise UserError(f"{path}: needs ffmpeg, which is not installed; a name that ends in .gif does not")
    times = np.arange(scene.t[0], scene.t[-1] + 1e-9, 1 / FRAMES_PER_SECOND)
    at = np.searchsorted(scene.t, times).clip(0, len(scene.t) - 1)
    points = _points(scene, at)
    figure, arm, held, lines = _canvas(scene, points)

    def draw(k: int) -> None:
        arm.set_data_3d(*points[k].T)
        held.set_data_3d(*points[k, -1:].T)
        held.set_markersize(9 * np.sqrt(scene.payload[at[k]] / HEAVY))
        for line in lines:
            line.set_xdata([scene.t[at[k]]] * 2)

    moving = FuncAnimation(figure, draw, frames=len(at), interval=1e3 / FRAMES_PER_SECOND, init_func=lambda: ())
    with TemporaryDirectory() as folder:  # the writers want a name with its ending, and `new_file` writes under another
        drawn = Path(folder) / path.name
        moving.save(drawn, writer=writer(fps=FRAMES_PER_SECOND), dpi=90)
        with new_file(path) as file:
            file.write(drawn.read_bytes())
    plt.close(figure)


def _points(scene: Scene, at: np.ndarray) -> np.ndarray:
    """Base, origins of the joints and the tool at some instants [m], (frames, n + 2, 3)."""
    body, result = rigid_body(scene.robot), []
    for q in scene.q[:, at].T:
        frames = np.array(body.joint_frames(q))
        tool = np.array(body.tool_position(q, scene.tool.position)).reshape(1, 3)
        result.append(np.concatenate([np.zeros((1, 3)), frames[9:].T, tool]))
    return np.array(result)


def _canvas(scene: Scene, points: np.ndarray) -> tuple[Any, Any, Any, list[Any]]:
    """The figure with what stays still, and what moves: the arm, the payload, and the line at the present time in each plot."""
    rows = len(scene.labels)
    figure = plt.figure(figsize=(10, 4.8))
    grid = figure.add_gridspec(rows, 2, width_ratios=(1, 1.1))
    space = figure.add_subplot(grid[:, 0], projection="3d")
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    centre, half = (low + high) / 2, 0.55 * max(float(np.max(high - low)), 1e-3)
    for name, c in zip("xyz", centre, strict=True):
        space.set(**{f"{name}lim": (c - half, c + half), f"{name}label": f"{name} [m]"})
    space.tick_params(labelsize=7)
    space.set_box_aspect((1, 1, 1))
    flat = int(np.argmin(high - low))  # seen along the axis in which it moves least
    space.view_init(elev=18 if flat != 2 else 60, azim=-70 if flat == 1 else -20)
    (arm,) = space.plot(*points[0].T, "-o", color=COLOURS[0], lw=4, ms=6)
    (held,) = space.plot(*points[0, -1:].T, "o", color=COLOURS[1])
    figure.suptitle(scene.title, fontsize=11)
    lines = []
    for i, label in enumerate(scene.labels):
        axis = figure.add_subplot(grid[i, 1])
        for colour, (name, values) in zip(COLOURS, scene.torques.items(), strict=False):
            axis.plot(scene.t, values[i], color=colour, lw=1.2, label=name)
        lines.append(axis.axvline(scene.t[0], color="0.3", lw=1))
        axis.set_title(f"{label} [Nm]", loc="left", **FOOTER)
        axis.tick_params(labelsize=7)
        if i == 0:
            axis.legend(fontsize=7, loc="upper right")
        if i == rows - 1:
            axis.set_xlabel("time [s]", fontsize=8)
    figure.tight_layout()
    return figure, arm, held, lines
