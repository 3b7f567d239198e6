"""BVH files, with Y up, lengths in centimetres or metres, and Euler angles in degrees.

Only this package converts between these conventions and the world.
"""

from bodycap_batch.formats.bvh.reader import read_bvh
from bodycap_batch.formats.bvh.roles import ROLES, assign_roles
from bodycap_batch.formats.bvh.user_skeleton import RigOptions, inspect_rig, missing_roles, read_rig
from bodycap_batch.formats.bvh.writer import write_bvh

__all__ = [
    "ROLES",
    "RigOptions",
    "assign_roles",
    "inspect_rig",
    "missing_roles",
    "read_bvh",
    "read_rig",
    "write_bvh",
]
