"""From recordings to a calibrated model: samples, least squares, covariance, prediction error.

Imports `recordings`, `simulation` and what stands below them."""
