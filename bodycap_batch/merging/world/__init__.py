"""The world: planes of the map, the vertical, the floor, and the transform from the solved frame."""
