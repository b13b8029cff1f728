"""The ground: merges, keeps, shows and hands out the map. Never imports `air`."""
