"""How the aircraft moves: missions, wind, and one smooth trajectory."""
