"""Flights in the formats of other programs."""
