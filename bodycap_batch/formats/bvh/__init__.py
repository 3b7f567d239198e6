"""BVH: Y up, degrees, Euler angles in a chosen order, centimetres; converted here and nowhere else."""

from bodycap_batch.formats.bvh.reader import read_bvh
from bodycap_batch.formats.bvh.roles import assign_roles
from bodycap_batch.formats.bvh.writer import write_bvh

__all__ = ["assign_roles", "read_bvh", "write_bvh"]
