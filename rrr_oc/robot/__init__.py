"""The robot: a serial chain from a URDF, its rigid-body dynamics, its inertial parameters and its drives.

Imports `numerics`."""
