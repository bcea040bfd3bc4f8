"""Which physics a calibrated model lacks, and how well it predicts once that is added.

Imports `calibration`, `excitation` and what stands below them."""
