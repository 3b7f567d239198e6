"""Projection: find the motion of the rigid skeleton that is nearest to the solution of the motion graph."""
