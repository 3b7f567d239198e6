"""The data types that all stages share: cameras, maps, trajectories, skeletons and motions; their geometry."""
