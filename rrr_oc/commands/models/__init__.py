"""The commands for what calibrations and diagnoses leave: models for other programs, and models side by side."""
