"""Readers and writers of file formats; each module handles the axes and units of its format."""
