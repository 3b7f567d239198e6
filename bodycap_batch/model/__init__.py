"""The data types that all stages share (camera, map, trajectory, skeleton, motion), and their geometry."""
