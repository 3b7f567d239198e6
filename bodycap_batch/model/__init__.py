"""The data types that all stages share (cameras, maps, trajectories, skeletons, motions) and their geometry."""
