"""What leaves the aircraft, in which order and how fast."""
