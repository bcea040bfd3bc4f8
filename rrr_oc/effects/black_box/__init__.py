"""Terms for torques that no law of the catalogue explains."""
