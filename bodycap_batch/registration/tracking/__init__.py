"""Track map points from keyframes into the frames between them."""
