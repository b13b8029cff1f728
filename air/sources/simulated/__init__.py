"""The flight simulator: world, flight and camera apart."""
