"""Readers and writers of file formats. Each format's axes, units and conventions are handled in its own module."""
