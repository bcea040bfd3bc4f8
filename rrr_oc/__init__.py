"""Optimal control and system identification of robot arms with elastic actuation."""

__version__ = "0.1.0"
