"""Estimate the poses of single frames from their observations, and test each pose."""
