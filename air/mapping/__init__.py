"""From posed photos to map tiles: stereo, fusion, tiles."""
