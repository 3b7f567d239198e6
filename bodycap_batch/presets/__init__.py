"""Data files of the skeleton presets."""
