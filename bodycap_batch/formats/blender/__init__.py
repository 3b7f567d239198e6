"""Files for Blender: a script that builds the scene of the results, as a file and as an extension; .blend."""

from bodycap_batch.formats.blender.writer import write_blend, write_blender_files

__all__ = ["write_blend", "write_blender_files"]
