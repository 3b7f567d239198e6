"""A stick figure for formats that show nothing without a mesh: one slim spindle a bone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose

_WAIST_RATIO = 0.15
"""Where along the bone its spindle is widest."""
_MIN_BONE_M = 1e-4
_WIDTH_SHARE, _WIDTH_M = 0.08, (0.008, 0.03)
"""Half width: this share of the length, within these bounds."""
_FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [5, 1, 2], [5, 2, 3], [5, 3, 4], [5, 4, 1]])


@dataclass(frozen=True, slots=True, kw_only=True)
class StickFigure:
    """A triangle mesh in world axes, bound to a skeleton in its rest pose.

    Attributes:
        vertices_m: (V,3).
        normals: (V,3) unit normals of the flat faces.
        faces: (F,3) vertex indices, counter-clockwise seen from outside.
        joints: (V,) the one joint that moves each vertex.
    """

    vertices_m: FloatArray
    normals: FloatArray
    faces: IntArray
    joints: IntArray


def make_stick_figure(skeleton: SkeletonModel) -> StickFigure:
    """One spindle from each joint to each of its children and to its end; bones of zero length have none.

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
    """Each joint with the far end (3,) of each of its bones; a root on the floor has none."""
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
    """The six corners (6,3) of a slim octahedron: start, four around the waist, end."""
    along = end - start
    length = float(np.linalg.norm(along))
    along = along / length
    side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(along, side)
    half = float(np.clip(_WIDTH_SHARE * length, *_WIDTH_M))
    waist = start + _WAIST_RATIO * length * along
    around = [waist + half * offset for offset in (side, other, -side, -other)]
    return np.array([start, *around, end])
