"""FBX files in centimetres, Y up, facing +Z. Blender writes the files in a separate process."""

from bodycap_batch.formats.fbx.blender_process import find_blender, require_blender
from bodycap_batch.formats.fbx.writer import write_fbx

__all__ = ["find_blender", "require_blender", "write_fbx"]
