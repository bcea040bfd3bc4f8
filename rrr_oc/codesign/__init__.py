"""Springs and motion of a task as one problem: multistart, purchasable hardware, certificates, transfer to a calibrated model.

Imports `optimal_control`, `simulation`, `calibration` and what stands below them."""
