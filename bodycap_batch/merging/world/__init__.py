"""The vertical and the floor: the axes of the world."""
