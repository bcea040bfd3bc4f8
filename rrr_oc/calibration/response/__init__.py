"""Calibration on the simulated response: the simulation of candidates, and the methods that calibrate on it.

Imports what `calibration` imports, and `calibration`."""
