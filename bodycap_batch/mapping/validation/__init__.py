"""Checks of a finished map, and repairs."""
