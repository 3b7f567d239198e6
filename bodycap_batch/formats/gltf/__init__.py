"""Binary glTF (GLB) files in metres, Y up, facing +Z: a skinned mannequin with its motion."""

from bodycap_batch.formats.gltf.reader import read_glb
from bodycap_batch.formats.gltf.writer import write_glb

__all__ = ["read_glb", "write_glb"]
