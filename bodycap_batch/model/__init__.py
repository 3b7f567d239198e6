"""What all stages share: poses, cameras, maps, skeletons, motions, and the geometry on them."""
