"""The robot: a serial chain from a URDF or MJCF, its rigid-body dynamics, its inertial parameters and its drives.

Imports `numerics`."""
