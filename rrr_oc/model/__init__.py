"""A robot with effects as CasADi functions, motions, and the torques that a motion needs.

Imports `numerics`, `robot` and `effects`."""
