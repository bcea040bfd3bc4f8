"""A scene in the browser, by the package viser: the arm, its springs and payload, a simulated arm beside it, and their torques."""

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any

import numpy as np

from rrr_oc.errors import UserError
from rrr_oc.report.figures import COLOURS
from rrr_oc.report.moving.scene import (
    HELD,
    Rod,
    Scene,
    chain,
    coil_points,
    payload_radius,
    poses,
    rods,
    tension_colour,
    thickness,
)
from rrr_oc.robot.robot import Robot, ToolPoint

TWIN, SEE_THROUGH = (0.33, 0.51, 0.21, 1.0), 0.45  # colour and opacity of the simulated arm
PLOT_EVERY = 0.5  # [s] between two marks of the present time in the plot while it plays
PLOTTED = 500  # samples of a plot; doubled, finer and slower ones


@dataclass(frozen=True)
class Shown:
    """What the viewer shows under one name.

    Attributes:
        scene: The motion.
        twin: Positions of the simulated arm [rad], (n, K); None where there is none.
    """

    scene: Scene
    twin: np.ndarray | None = None


class Viewer:
    """A server of one or several motions of an arm, of which one is shown.

    Its controls are those of the browser: `time`, `play`, `choice`, `joint`. `arm` and `twin` are the frames of the joints, base
    first, whose `position` and `wxyz` change with the time.
    """

    def __init__(self, names: Sequence[str], load: Callable[[str], Shown], port: int) -> None:
        """Start the server on this machine, and show the first name.

        Args:
            names: What can be chosen.
            load: What belongs to a name.
            port: Where the browser finds it; the next free one if it is taken.

        Raises:
            UserError: The package viser is missing.
        """
        try:
            import viser  # an extra
            from viser import uplot
        except ImportError:
            raise UserError("the package viser is not installed; pip install viser brings it") from None
        self._load, self._lock, self._playing, self._plotted_at = load, threading.RLock(), False, 0.0
        self.shown = load(names[0])
        with redirect_stdout(StringIO()):  # a banner with the address, which the command says itself
            self.server = viser.ViserServer("127.0.0.1", port, label="rrr-oc view", verbose=False)
        robot, tool = self.shown.scene.robot, self.shown.scene.tool
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_grid("/floor", width=4.0, height=4.0, cell_size=0.1, section_size=0.5, shadow_opacity=0.2)
        self.arm = _arm(self.server, "arm", robot, tool, None)
        self.twin = _arm(self.server, "twin", robot, tool, TWIN)
        self._moving: list[Any] = []
        self._controls(uplot, names)
        self._choose()
        self._look()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://localhost:{self.server.get_port()}"

    def go_on(self, seconds: float) -> None:
        """Let time pass, from the end to the beginning, if it plays."""
        if self._playing:
            last = float(self.time.max)
            self.time.value = 0.0 if self.time.value >= last else min(round(self.time.value + seconds, 3), last)
            self.show(plot=time.monotonic() - self._plotted_at > PLOT_EVERY)

    def show(self, plot: bool = True) -> None:
        """Put everything where it is at the time of the slider; `plot`: the mark in the plot too, which browsers draw slowly."""
        with self._lock, self.server.atomic():
            scene, twin = self.shown.scene, self.shown.twin
            k = min(int(np.searchsorted(scene.t, scene.t[0] + self.time.value - 1e-9)), len(scene.t) - 1)
            _place(self.arm, scene.robot, scene.q[:, k])
            if twin is not None and np.isfinite(twin[:, k]).all():
                _place(self.twin, scene.robot, twin[:, k])
            self.payload.position = chain(scene.robot, scene.tool, scene.q[:, k])[-1]
            self.payload.visible = bool(scene.payload[k] > 0)
            for spring, line in zip(scene.springs, self._moving, strict=True):
                share = float(spring.tension[k]) / scene.most if scene.most > 0 else 0.0
                points = coil_points(scene, spring, k, share)
                line.points = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
                line.colors = np.full((len(points) - 1, 2, 3), np.round(255 * tension_colour(share)), np.uint8)
            self.readout.content = _readout(scene, k)
            if scene.labels and plot:
                self._plotted_at = time.monotonic()
                self.plot.data, self.plot.scales = self._plotted(k), self._scales()

    def stop(self) -> None:
        """End the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def _controls(self, uplot: Any, names: Sequence[str]) -> None:
        gui, scene, self._scale = self.server.gui, self.shown.scene, uplot.Scale
        self.choice = gui.add_dropdown("recording", tuple(names), visible=len(names) > 1)
        self.time = gui.add_slider("time [s]", 0.0, 1.0, 0.001, 0.0)
        self.play = gui.add_button("play / pause")
        self.joint = gui.add_dropdown("torque of", scene.labels or ("–",), visible=bool(scene.labels))
        names = [*scene.torques, "now"]
        series = [uplot.Series(label=name, stroke=c, width=2) for name, c in zip(names[:-1], COLOURS, strict=False)]
        now = uplot.Series(
            label="now", stroke="#000000", width=0, points=uplot.Series_Points(show=True, size=9, fill="#000000")
        )
        axes = (uplot.Axis(label="time [s]"), uplot.Axis(label="torque [Nm]"))
        data = tuple(np.zeros(2) for _ in range(len(names) + 1))
        self.plot = gui.add_uplot(
            data,
            (uplot.Series(label="t"), *series, now),
            axes=axes,
            scales={"x": self._scale(time=False, auto=True)},
            aspect=1.2,
            visible=bool(scene.labels),
        )
        self.readout = gui.add_markdown("")
        self.choice.on_update(lambda _: self._choose())
        self.time.on_update(lambda _: None if self._playing else self.show())
        self.joint.on_update(lambda _: self.show())
        self.play.on_click(lambda _: self._toggle())

    def _toggle(self) -> None:
        self._playing = not self._playing
        self.show()

    def _choose(self) -> None:
        """Show what is chosen, from its beginning."""
        with self._lock:
            self.shown = self._load(self.choice.value)
            scene = self.shown.scene
            for line in self._moving:
                line.remove()
            wire = 0.4 * thickness(scene.robot, scene.tool)
            nothing = np.zeros((1, 2, 3), np.float32)
            self._moving = [
                self.server.scene.add_line_segments(f"/springs/{i}", nothing, (0, 0, 0), thickness=wire)
                for i in range(len(scene.springs))
            ]
            self.payload = self.server.scene.add_icosphere(
                "/payload", payload_radius(scene, int(np.argmax(scene.payload))), _bytes(HELD)
            )
            self.twin[0].visible = self.shown.twin is not None
            self.time.max = max(float(np.floor(1e3 * (scene.t[-1] - scene.t[0])) / 1e3), 1e-3)
            self.time.value = 0.0
            self.show()

    def _plotted(self, k: int) -> tuple[np.ndarray, ...]:
        """Times, the torques of the joint that is chosen, and the first of these at the index `k` alone."""
        scene = self.shown.scene
        row = scene.labels.index(self.joint.value)
        some = np.unique(np.append(np.linspace(0, len(scene.t) - 1, PLOTTED).astype(int), k))
        torques = [values[row][some] for values in scene.torques.values()]
        now = np.where(some == k, torques[0], np.nan)
        return (scene.t[some] - scene.t[0], *torques, now)

    def _scales(self) -> dict[str, Any]:
        """Axes of the plot; of torques a given range, for the browser finds none where the mark leaves gaps."""
        scene = self.shown.scene
        values = np.array([v[scene.labels.index(self.joint.value)] for v in scene.torques.values()])
        low, high = (float(f(values)) for f in (np.nanmin, np.nanmax))
        margin = 0.05 * max(high - low, 1e-3)
        return {
            "x": self._scale(time=False, auto=True),
            "y": self._scale(auto=False, range=(low - margin, high + margin)),
        }

    def _look(self) -> None:
        """Where a browser's camera begins: to the side of the motion, near enough to fill the picture."""
        scene = self.shown.scene
        points = scene.points(np.unique(np.linspace(0, len(scene.t) - 1, 40).astype(int))).reshape(-1, 3)
        low, high = points.min(axis=0), points.max(axis=0)
        side = np.array([1.0, -0.35, 0.35]) if np.argmin((high - low)[:2]) == 0 else np.array([0.35, -1.0, 0.35])
        self.server.initial_camera.look_at = (low + high) / 2
        self.server.initial_camera.position = (low + high) / 2 + 1.4 * max(float(np.max(high - low)), 1e-2) * side


def _arm(server: Any, name: str, robot: Robot, tool: ToolPoint, colour: tuple[float, float, float, float] | None) -> list[Any]:
    """The frames of an arm, base first, each with its rods; see-through where it has a colour of its own."""
    frames = [server.scene.add_frame(f"/{name}", show_axes=False)]
    frames += [server.scene.add_frame(f"/{name}/{i}", show_axes=False) for i in range(robot.n)]
    for i, rod in enumerate(rods(robot, tool)):
        at = f"/{name}/{rod.joint}/rod{i}" if rod.joint >= 0 else f"/{name}/rod{i}"
        vertices, faces = _mesh(rod)
        own = _bytes(rod.colour if colour is None else colour)
        server.scene.add_mesh_simple(at, vertices, faces, color=own, opacity=None if colour is None else SEE_THROUGH)
    return frames


def _mesh(rod: Rod) -> tuple[np.ndarray, np.ndarray]:
    """A rod with round ends as triangles: vertices (m, 3) [m] and faces (p, 3)."""
    import trimesh  # comes with viser

    way = rod.ends[1] - rod.ends[0]
    length = float(np.linalg.norm(way))
    mesh = trimesh.creation.capsule(height=length, radius=rod.radius, count=(16, 16))
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), way / length))
    mesh.apply_translation(rod.ends.mean(axis=0))
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)


def _place(frames: Sequence[Any], robot: Robot, q: np.ndarray) -> None:
    import viser.transforms

    for frame, pose in zip(frames[1:], poses(robot, q), strict=True):
        frame.position = pose[:3, 3]
        frame.wxyz = viser.transforms.SO3.from_matrix(pose[:3, :3]).wxyz


def _readout(scene: Scene, k: int) -> str:
    """The torques at an index as a table of Markdown."""
    if not scene.labels:
        return scene.title
    head = f"| [Nm] | {' | '.join(scene.torques)} |\n| --- |{' --- |' * len(scene.torques)}\n"
    rows = (
        f"| {name} | " + " | ".join(f"{v[i, k]:.2f}" for v in scene.torques.values()) + " |\n"
        for i, name in enumerate(scene.labels)
    )
    return f"**{scene.title}**\n\n{head}{''.join(rows)}"


def _bytes(colour: Sequence[float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in colour[:3])
    return red, green, blue
