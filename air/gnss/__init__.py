"""GNSS basics: ephemerides, satellite orbits and clocks, atmosphere, single-point positions."""
