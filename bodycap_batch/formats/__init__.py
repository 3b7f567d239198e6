"""Readers and writers of file formats. Each module converts the axes and units of one format."""
