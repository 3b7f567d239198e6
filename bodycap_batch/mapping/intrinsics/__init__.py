"""Check camera intrinsics and shutter readout times against the map, and refine them."""
