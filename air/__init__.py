"""The aircraft: device bytes to a growing map. Never imports `ground`."""
