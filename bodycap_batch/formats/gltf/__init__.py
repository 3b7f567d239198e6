"""glTF binary (GLB): metres, Y up, facing +Z; one skin of all joints, a stick figure and the motion."""

from bodycap_batch.formats.gltf.reader import read_glb
from bodycap_batch.formats.gltf.writer import write_glb

__all__ = ["read_glb", "write_glb"]
