"""Map points tracked from keyframes into the frames between them."""
