"""Motions shown: what is in the picture, its shapes in space, moving pictures in files, and a viewer in the browser."""

from typing import Literal

Renderer = Literal["mujoco", "matplotlib"]
