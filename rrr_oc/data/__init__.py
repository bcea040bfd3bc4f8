"""Presets as JSON: tasks, actuators, purchasable springs, and the paper's published results, which `published` reads. Imports nothing."""
