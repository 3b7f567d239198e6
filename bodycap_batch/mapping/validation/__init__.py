"""Checks of a map."""
