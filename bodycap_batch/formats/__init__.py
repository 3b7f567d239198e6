"""Readers and writers, one file a format, each with its own conventions."""
