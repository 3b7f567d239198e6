"""The table of lens profiles, made by ``python -m tests.lens_table``."""
