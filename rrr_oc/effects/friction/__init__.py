"""Friction in the drives."""
