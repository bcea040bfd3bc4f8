"""The one estimator, of calibration and diagnosis: data, noise and discrepancy, evidence, Gauss–Newton, and intervals."""
