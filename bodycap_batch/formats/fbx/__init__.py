"""FBX files of the motion (centimetres, Y up, facing +Z) and of cameras, and Alembic files of cameras.

Blender writes the files in a separate process.
"""

from bodycap_batch.formats.fbx.blender_process import find_blender, require_blender
from bodycap_batch.formats.fbx.writer import write_cameras_with_blender, write_fbx

__all__ = ["find_blender", "require_blender", "write_cameras_with_blender", "write_fbx"]
