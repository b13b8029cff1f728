"""What the cameras make of it: photos and rolling-shutter video."""
