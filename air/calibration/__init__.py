"""Calibration from recordings: a camera by itself, and against the IMU."""
