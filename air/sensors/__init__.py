"""Devices: their bytes → measurements, without I/O and without a clock."""
