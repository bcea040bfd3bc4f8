"""What no springs can be better than: on a given motion (`on_motion`), and over all motions of a task (`over_motions`)."""
