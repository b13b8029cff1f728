"""Satellites, air and receivers: what a GNSS receiver sends."""
