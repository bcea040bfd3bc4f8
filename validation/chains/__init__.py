"""Families of arms whose recordings passed a real chain of measurement, and what the tool makes of them. The plant does not import it."""
