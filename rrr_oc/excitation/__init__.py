"""Motions to record: D-optimal Fourier series within an arm's limits.

Imports `recordings` and what stands below it."""
