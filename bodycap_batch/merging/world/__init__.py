"""The world: planes of the map, the vertical, the floor, and the transform to the world."""
