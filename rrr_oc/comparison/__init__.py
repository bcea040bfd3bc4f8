"""Two results side by side: what differs between two calibrated models or diagnoses by more than its error, and between two designs."""
