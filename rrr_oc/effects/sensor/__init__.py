"""Errors of the torque and position channels."""
