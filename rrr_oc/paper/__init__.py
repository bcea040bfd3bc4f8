"""The paper's own way: its parametrisation, its evolution, its experiments, statistics of their trials.

Imports `codesign` and what stands below it."""
