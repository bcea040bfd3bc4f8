"""Motions as files of moving pictures: the arm with its payload and springs, and the torques of its joints beside it."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from PIL import Image

from rrr_oc.errors import UserError
from rrr_oc.report.figures import COLOURS, FOOTER, plt
from rrr_oc.report.moving import Renderer
from rrr_oc.report.moving.rendering import SIZE, NoRenderer, rendered
from rrr_oc.report.moving.scene import Scene, tension_colour
from rrr_oc.storage import new_file

FRAMES_PER_SECOND = 20  # of the picture
DPI = 90  # of the picture
SHADES = 128  # of a GIF
EMPTY: dict[str, Any] = {"frame_on": False, "xticks": [], "yticks": []}  # axes of which nothing is seen
HEAVY = 2.0  # [kg] of a payload drawn at the usual size of a joint; its area grows in proportion


class GifWriter(PillowWriter):
    """With one palette for all frames and no dither, which halves the file."""

    def finish(self) -> None:
        frames = [frame.convert("RGB") for frame in self._frames]
        some = np.vstack([np.asarray(frame).reshape(-1, 3) for frame in frames[:: max(len(frames) // 8, 1)]])
        each = np.unique(some // 8 * 8, axis=0)  # beside what fills the picture, so that thin lines keep their colour
        palette = Image.fromarray(np.vstack([some[::50], each])[None]).quantize(SHADES)
        self._frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        super().finish()


WRITERS = {".gif": GifWriter, ".mp4": FFMpegWriter}


def animate(scene: Scene, path: Path, renderer: Renderer = "mujoco") -> tuple[Renderer, str]:
    """Write a scene as GIF or MP4, in real time.

    Args:
        renderer: "mujoco": solid bodies, where there is OpenGL; "matplotlib": lines.

    Returns:
        The renderer that was used, and why it is not the one asked for, "" where it is.

    Raises `UserError` for another ending of the name, and where an MP4 is asked for and ffmpeg is missing.
    """
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise UserError(f"{path}: allowed are names that end in {' or '.join(WRITERS)}")
    times = np.arange(scene.t[0], scene.t[-1] + 1e-9, 1 / FRAMES_PER_SECOND)
    at, why = np.searchsorted(scene.t, times).clip(0, len(scene.t) - 1), ""
    with plt.rc_context(_ffmpeg()), closing(rendered(scene, at)) as solid:
        if not writer.isAvailable():
            raise UserError(
                f"{path}: needs ffmpeg, which is not installed; pip install imageio-ffmpeg brings it, "
                "and a name that ends in .gif does without"
            )
        pictures = None
        if renderer == "mujoco":
            try:
                pictures = chain([next(solid)], solid)
            except NoRenderer as error:
                renderer, why = "matplotlib", str(error)
        figure, draw = _drawn(scene, at, pictures)
        with TemporaryDirectory() as folder:  # the writers want a name with its ending, and `new_file` writes under another
            drawn, film = Path(folder) / path.name, writer(fps=FRAMES_PER_SECOND)
            with film.saving(figure, str(drawn), dpi=DPI):
                for k in range(len(at)):
                    draw(k)
                    film.grab_frame()
            with new_file(path) as file:
                file.write(drawn.read_bytes())
    plt.close(figure)
    return renderer, why


def _ffmpeg() -> dict[Any, Any]:
    """Where matplotlib finds ffmpeg: the machine's, else the one that the package imageio-ffmpeg brings."""
    if shutil.which("ffmpeg") is None and find_spec("imageio_ffmpeg") is not None:
        from imageio_ffmpeg import get_ffmpeg_exe  # an extra

        return {"animation.ffmpeg_path": get_ffmpeg_exe()}
    return {}


def _drawn(scene: Scene, at: np.ndarray, pictures: Iterator[np.ndarray] | None) -> tuple[Any, Callable[[int], None]]:
    """The figure, and a function that draws its frame of a number; frames are drawn in turn, from the first."""
    figure, grid = _page(scene)
    plots = _torques(scene, figure, grid)
    space = figure.add_subplot(grid[:, 0], **({"projection": "3d"} if pictures is None else EMPTY))
    figure.tight_layout()
    if pictures is None:
        show = _lines(scene, at, space)
    else:
        figure, plots, space = _as_background(figure, plots, space)
        show = _solid(scene, space, pictures)
    lines = [axis.axvline(scene.t[0], color="0.3", lw=1) for axis in plots]

    def draw(k: int) -> None:
        show(k)
        for line in lines:
            line.set_xdata([scene.t[at[k]]] * 2)

    return figure, draw


def _page(scene: Scene) -> tuple[Any, Any]:
    """The figure with its title, and its grid: the arm on the left, one plot a joint on the right."""
    figure = plt.figure(figsize=(10, max(4.8, 1.1 * len(scene.labels))), dpi=DPI)
    figure.suptitle(scene.title, fontsize=11)
    return figure, figure.add_gridspec(max(len(scene.labels), 1), 2, width_ratios=(1, 1.1))


def _as_background(figure: Any, plots: list[Any], space: Any) -> tuple[Any, list[Any], Any]:
    """A figure that has another one as a picture, which is then drawn only once, and empty axes in the places of its own."""
    figure.canvas.draw()
    drawn = np.asarray(figure.canvas.buffer_rgba()).copy()
    front = plt.figure(figsize=figure.get_size_inches(), dpi=DPI)
    front.figimage(drawn, zorder=-1)
    front_plots = [front.add_axes(axis.get_position(), xlim=axis.get_xlim(), **EMPTY) for axis in plots]
    front_space = front.add_axes(space.get_position(), **EMPTY)
    plt.close(figure)
    return front, front_plots, front_space


def _solid(scene: Scene, axis: Any, pictures: Iterator[np.ndarray]) -> Callable[[int], None]:
    """The arm as MuJoCo draws it."""
    image = axis.imshow(np.full((SIZE, SIZE, 3), 255, np.uint8))
    if scene.most > 0:
        names = ("no load", f"{scene.most / 2:.3g} Nm", f"{scene.most:.3g} Nm")
        for share, name in zip((0.0, 0.5, 1.0), names, strict=True):
            axis.plot([], [], lw=4, color=tension_colour(share), label=name)
        axis.legend(fontsize=7, loc="upper left", title="springs", title_fontsize=7)
    return lambda k: image.set_data(next(pictures))


def _lines(scene: Scene, at: np.ndarray, space: Any) -> Callable[[int], None]:
    """The arm as lines in three dimensions."""
    points = scene.points(at)
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

    def show(k: int) -> None:
        arm.set_data_3d(*points[k].T)
        held.set_data_3d(*points[k, -1:].T)
        held.set_markersize(9 * np.sqrt(scene.payload[at[k]] / HEAVY))

    return show


def _torques(scene: Scene, figure: Any, grid: Any) -> list[Any]:
    """A plot of the torques of each joint."""
    rows = len(scene.labels)
    plots = []
    for i, label in enumerate(scene.labels):
        axis = figure.add_subplot(grid[i, 1])
        for colour, (name, values) in zip(COLOURS, scene.torques.items(), strict=False):
            axis.plot(scene.t, values[i], color=colour, lw=1.2, label=name)
        plots.append(axis)
        axis.set_title(f"{label} [Nm]", loc="left", **FOOTER)
        axis.tick_params(labelsize=7)
        if i == 0:
            axis.legend(fontsize=7, loc="upper right")
        if i == rows - 1:
            axis.set_xlabel("time [s]", fontsize=8)
    return plots
