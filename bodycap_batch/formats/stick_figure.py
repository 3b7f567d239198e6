"""The mesh of a stick figure, with one slim octahedron per bone.

File formats whose viewers do not show bones need such a mesh.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose

_WAIST_RATIO = 0.15
"""Distance from the start of a bone to the place where its octahedron is widest, as a fraction of the bone's
length. Evidence: none; it only affects the appearance."""

_MIN_BONE_M = 1e-4
"""Minimum length, metres, of a bone that gets an octahedron. Evidence: none; the limit is far below the
length of any visible bone."""

_HALF_WIDTH_RATIO = 0.08
"""Ratio of half the width of the octahedron to the length of the bone. Evidence: none; it only affects the
appearance."""

_HALF_WIDTH_RANGE_M = (0.008, 0.03)
"""Smallest and largest value of half the width of an octahedron, metres. Evidence: none; the values only
affect the appearance."""

_FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [5, 1, 2], [5, 2, 3], [5, 3, 4], [5, 4, 1]])
"""Corner indices of the eight triangles of an octahedron, counter-clockwise as seen from outside. An index is
a row of the result of `_spindle_corners`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StickFigure:
    """A triangle mesh with V vertices and F faces, in world axes.

    The mesh is given in the rest pose of a skeleton, and each vertex is bound to a joint.

    Attributes:
        vertices_m: (V,3) vertices, metres.
        normals: (V,3) unit normal of the flat face that each vertex belongs to.
        faces: (F,3) vertex indices of the triangles, counter-clockwise as seen from outside.
        joints: (V,) index of the joint that each vertex moves with.
    """

    vertices_m: FloatArray
    normals: FloatArray
    faces: IntArray
    joints: IntArray


def make_stick_figure(skeleton: SkeletonModel) -> StickFigure:
    """Return the mesh of a stick figure.

    The mesh contains an octahedron from each joint to each child of the joint, and to the far end of a bone
    without children. Bones without length have no octahedron.

    Raises:
        ValueError: No bone has a length.
    """
    rest = rest_pose(skeleton)
    corners, joints = [], []
    for joint, end in _iterate_bones(skeleton, rest):
        corners.append(_spindle_corners(rest[joint, :3, 3], end)[_FACES].reshape(-1, 3))
        joints.append(np.full(3 * len(_FACES), joint))
    if not corners:
        raise ValueError("no bone has a length")
    vertices = np.concatenate(corners)
    triangles = vertices.reshape(-1, 3, 3)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return StickFigure(
        vertices_m=vertices,
        normals=np.repeat(normals, 3, axis=0),
        faces=np.arange(len(vertices)).reshape(-1, 3),
        joints=np.concatenate(joints),
    )


def _iterate_bones(skeleton: SkeletonModel, rest: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Yield the joint and the far end (3,) of each bone in the rest pose, in the world.

    A root on the floor has no bone.

    Args:
        skeleton: The skeleton, with J joints.
        rest: (J,4,4) joint poses in the rest pose, in the world.
    """
    on_floor = len(skeleton.joints) > 1 and skeleton.roles[:2] == ("", "Hips")
    for joint, parent in enumerate(skeleton.parents.tolist()):
        end = skeleton.end_offsets_m[joint]
        bones = [(parent, rest[joint, :3, 3])] if parent > 0 or (parent == 0 and not on_floor) else []
        if np.isfinite(end).all():
            bones.append((joint, rest[joint, :3, 3] + rest[joint, :3, :3] @ end))
        for owner, tip in bones:
            if np.linalg.norm(tip - rest[owner, :3, 3]) > _MIN_BONE_M:
                yield owner, tip


def _spindle_corners(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the corners (6,3) of a slim octahedron: start, four corners at the largest width, end."""
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(along, side)
    half = float(np.clip(_HALF_WIDTH_RATIO * length, *_HALF_WIDTH_RANGE_M))
    waist = start + _WAIST_RATIO * length * along
    around = [waist + half * offset for offset in (side, other, -side, -other)]
    return np.array([start, *around, end])
