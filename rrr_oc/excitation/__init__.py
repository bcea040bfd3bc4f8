"""Motions to record: D-optimal Fourier series within an arm's limits, and the paper's sweeps.

Imports `recordings` and what stands below it."""
