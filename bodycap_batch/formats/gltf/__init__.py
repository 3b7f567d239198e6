"""Binary glTF (GLB) files, Y up: a skinned mannequin with its motion, and animated cameras with the room."""

from bodycap_batch.formats.gltf.camera_scene import read_camera_glb, write_camera_glb
from bodycap_batch.formats.gltf.reader import read_glb
from bodycap_batch.formats.gltf.writer import write_glb

__all__ = ["read_camera_glb", "read_glb", "write_camera_glb", "write_glb"]
