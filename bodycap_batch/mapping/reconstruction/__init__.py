"""Incremental reconstruction and bundle adjustment."""
