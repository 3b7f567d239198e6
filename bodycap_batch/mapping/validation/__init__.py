"""Checks and repairs of a map."""
