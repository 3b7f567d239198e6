"""Recover the poses of lost frames."""
