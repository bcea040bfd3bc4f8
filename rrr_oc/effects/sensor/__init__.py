"""What sensors make of torques and positions."""
