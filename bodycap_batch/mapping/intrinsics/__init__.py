"""Camera intrinsics and shutter readout times, checked and refined against the map."""
