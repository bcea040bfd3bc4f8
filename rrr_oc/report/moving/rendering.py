"""Pictures of a scene by MuJoCo's renderer, without a screen."""

# pyright: reportAttributeAccessIssue=false
# (mujoco's wheel has no stubs)

import os
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from rrr_oc.report.moving.scene import Capsules, Scene, shapes
from rrr_oc.robot.rigid_body import upwards

SIZE = 560  # pixels each way
ROOM = """<mujoco>
  <statistic extent="{extent}" center="0 0 0"/>
  <visual>
    <global offwidth="{size}" offheight="{size}"/><quality shadowsize="1024" offsamples="4" numslices="12" numstacks="8"/>
    <headlight ambient=".45 .45 .45" diffuse=".35 .35 .35" specular=".1 .1 .1"/><map znear="0.01" shadowclip="2"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="1 1 1" rgb2=".86 .9 .95" width="64" height="64"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1=".93 .94 .95" rgb2=".86 .88 .9" width="256" height="256"/>
    <material name="tiles" texture="tiles" texrepeat="2 2" texuniform="true"/>
  </asset>
  <worldbody>
    <light pos="{side} {side} {high}" dir=".5 .5 -1.6" cutoff="70" exponent="1" diffuse=".55 .55 .55"/>
    {floor}
  </worldbody>
</mujoco>"""
FLOOR = '<geom type="plane" size="0 0 .1" pos="0 0 {height}" material="tiles"/>'


class NoRenderer(Exception):
    """MuJoCo's renderer does not work on this machine; the message says why."""


def rendered(scene: Scene, at: np.ndarray) -> Generator[np.ndarray, None, None]:
    """The scene at some instants, seen from one side, each (`SIZE`, `SIZE`, 3) of bytes.

    Raises `NoRenderer` at the first picture where there is no OpenGL.
    """
    points = scene.points(np.unique(np.linspace(0, len(scene.t) - 1, 60).astype(int))).reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    extent = max(float(np.max(high - low)), 1e-3)
    level = upwards(scene.robot.gravity)[2] > 0.99
    floor = FLOOR.format(height=min(0.0, low[2] - 0.1 * extent)) if level else ""
    room = mujoco.MjModel.from_xml_string(
        ROOM.format(size=SIZE, extent=extent, high=high[2] + 2 * extent, side=-extent, floor=floor)
    )
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = (low + high) / 2, 1.75 * extent
    flat = int(np.argmin(high - low))  # seen along the axis in which it moves least
    camera.azimuth, camera.elevation = (-25.0, 155.0)[flat == 0] if flat != 1 else 65.0, -14.0 if flat != 2 else -55.0
    data, option, seen = mujoco.MjData(room), mujoco.MjvOption(), mujoco.MjvScene(room, maxgeom=4000)
    mujoco.mj_forward(room, data)
    with _drawing_on(room) as context:
        view, pixels = mujoco.MjrRect(0, 0, SIZE, SIZE), np.zeros((SIZE, SIZE, 3), np.uint8)
        for k in at:
            mujoco.mjv_updateScene(room, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, seen)
            _add(seen, shapes(scene, int(k)))
            mujoco.mjr_render(view, seen, context)
            mujoco.mjr_readPixels(pixels, None, view, context)
            yield pixels[::-1].copy()


def _add(seen: Any, capsules: Capsules) -> None:
    """Add rods and balls to a scene of MuJoCo."""
    for (start, end), radius, colour in zip(capsules.ends, capsules.radius, capsules.colour, strict=True):
        geom = seen.geoms[seen.ngeom]
        ball = np.array_equal(start, end)
        kind = mujoco.mjtGeom.mjGEOM_SPHERE if ball else mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(geom, kind, np.full(3, radius), start, np.eye(3).ravel(), colour.astype(np.float32))
        if not ball:
            mujoco.mjv_connector(geom, kind, radius, start, end)
        seen.ngeom += 1


@contextmanager
def _drawing_on(room: mujoco.MjModel) -> Iterator[Any]:
    """The context of OpenGL that MUJOCO_GL names; else EGL where there is no screen. Raises `NoRenderer` where there is none."""
    try:
        if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not os.environ.get("DISPLAY"):
            from mujoco.egl import GLContext  # needs no screen, as MuJoCo's own choice does
        else:
            GLContext = mujoco.GLContext
        window = GLContext(SIZE, SIZE)
        window.make_current()
        context = mujoco.MjrContext(room, mujoco.mjtFontScale.mjFONTSCALE_100)
    except (
        ImportError,
        AttributeError,
        OSError,
        RuntimeError,
        mujoco.FatalError,
    ) as error:  # as libraries of OpenGL are missing
        raise NoRenderer(str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__) from None
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        yield context
    finally:
        context.free()
        window.free()
