"""Camera intrinsics and shutter readout times: check them against the map and refine them."""
