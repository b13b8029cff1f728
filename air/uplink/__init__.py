"""What the aircraft sends to the ground, in which order and at which pace."""
