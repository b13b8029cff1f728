"""Everything that can feed the aircraft, opened by URL."""
