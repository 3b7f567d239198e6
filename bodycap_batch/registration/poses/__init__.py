"""Poses of single frames from their observations, and the test of each pose."""
