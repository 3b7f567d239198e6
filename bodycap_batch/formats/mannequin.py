"""A plain mannequin: closed parts of a triangle mesh along the bones, which move with one or two joints.

Limbs are capsules, the trunk is one tube, and head and hands are ellipsoids. Parts overlap where they meet.
All sizes follow the bones and the stature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, interpolated
from bodycap_batch.model.bone_axes import bone_ends_m, has_floor_root, main_children
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose
from bodycap_batch.model.skeleton_presets import split_side

COLOUR_RGB = (0.62, 0.66, 0.70)
"""Colour of the mannequin, RGB, 0 to 1."""

_MIN_BONE_STATURE = 0.004
"""Minimum length of a bone with a shape of its own, in statures. Evidence: none."""

_LENGTHS = {("Hips", "Head"): 0.370, ("UpLeg", "Foot"): 0.491, ("Arm", "Hand"): 0.332}
"""Lengths between two joints along the bones, in statures, as in ``presets/humanoid.yaml``. The first joint
with its role, or with its role on the left or right side, is used."""

_RADIUS = {
    "Shoulder": 0.034, "Arm": 0.031, "ForeArm": 0.0235, "Hand": 0.0165,
    "UpLeg": 0.050, "Leg": 0.0325, "Foot": 0.0235, "ToeBase": 0.0155,
}  # fmt: skip
"""Radius of the body around each joint of a limb, in statures. Evidence: none; estimated from the girths of
a slim adult."""

_FREE_RADIUS = 0.007
"""Radius around joints without a role outside of limbs and trunk (fingers), in statures. Evidence: none."""

_TRUNK = np.array(
    [
        [-0.10, 0.092, 0.062],
        [0.00, 0.096, 0.064],
        [0.30, 0.080, 0.054],
        [0.55, 0.090, 0.058],
        [0.80, 0.099, 0.061],
        [0.93, 0.092, 0.054],
        [1.00, 0.062, 0.044],
    ]
)
"""Half width and half depth of the trunk in statures. First column: place between hips (0) and neck (1).
Evidence: none; only the appearance depends on it."""

_BLEND_STATURE = 0.035
"""Half the length along the trunk over which its surface passes from one joint to the next, in statures.
Evidence: none."""

_SIDES, _CAP_RINGS = 20, 6
"""Number of vertices around a part, and of rings in its rounded end. Evidence: none; the mesh then has some
5,000 vertices."""

_TRUNK_RING_STATURE = 0.02
"""Distance between two rings of the trunk, in statures. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mannequin:
    """A triangle mesh with V vertices and F faces in the T-pose of a skeleton, in world axes.

    Attributes:
        vertices_m: (V,3) vertices, metres.
        normals: (V,3) unit normals, which point out of the body.
        faces: (F,3) vertex indices of the triangles, counter-clockwise as seen from outside.
        joints: (V,2) indices of the joints that each vertex follows.
        weights: (V,2) weights of these joints, between 0 and 1; their sum is 1.
    """

    vertices_m: FloatArray
    normals: FloatArray
    faces: IntArray
    joints: IntArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class _Part:
    """A closed part of the body: rings of vertices around a line, with a point at both ends.

    Attributes:
        vertices: (V,3) vertices, metres: the first end, the rings, the last end.
        joints: (V,2) indices of the joints that each vertex follows.
        weights: (V,) weight of the first of these joints.
    """

    vertices: FloatArray
    joints: IntArray
    weights: FloatArray


def make_mannequin(skeleton: SkeletonModel) -> Mannequin:
    """Return the mesh of a person with the skeleton's proportions.

    Raises:
        ValueError: No bone has a length.
    """
    lengths = np.linalg.norm(np.concatenate([skeleton.offsets_m[1:], skeleton.end_offsets_m]), axis=1)
    if not np.nanmax(lengths, initial=0.0) > 0.0:
        raise ValueError("no bone has a length")
    parts = _parts(skeleton, _stature_m(skeleton))
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate(
        [start + _faces(len(part.vertices)) for start, part in zip(starts, parts, strict=False)]
    )
    first = np.concatenate([part.weights for part in parts])
    return Mannequin(
        vertices_m=vertices,
        normals=_normals(vertices, faces),
        faces=faces,
        joints=np.concatenate([part.joints for part in parts]),
        weights=np.stack([first, 1.0 - first], axis=1),
    )


def _stature_m(skeleton: SkeletonModel) -> float:
    """Return the stature, metres, from the lengths of trunk, leg and arm; from the extent without these."""
    lengths = np.linalg.norm(skeleton.offsets_m, axis=1)
    found, expected = 0.0, 0.0
    for (upper, lower), share in _LENGTHS.items():
        for side in ("", "Left", "Right"):
            first, last = (skeleton.index_of_role(side + role) for role in (upper, lower))
            length = 0.0 if first is None or last is None else _path_length(skeleton, lengths, first, last)
            if length > 0.0:
                found, expected = found + length, expected + share
                break
    if expected > 0.0:
        return found / expected
    extent = float(
        np.ptp(np.concatenate([rest_pose(skeleton)[:, :3, 3], bone_ends_m(skeleton)]), axis=0).max()
    )
    return extent if extent > 0.0 else 1.0


def _path_length(skeleton: SkeletonModel, lengths: FloatArray, first: int, last: int) -> float:
    """Return the length of the bones from the joint `first` to its descendant `last`; 0 if it is none."""
    total, joint = 0.0, last
    while joint > first:
        total += float(lengths[joint])
        joint = int(skeleton.parents[joint])
    return total if joint == first else 0.0


def _parts(skeleton: SkeletonModel, stature: float) -> list[_Part]:
    """Return the parts of the body: the trunk, and one for each other bone; two for head, hands and feet."""
    at, ends = rest_pose(skeleton)[:, :3, 3], bone_ends_m(skeleton)
    trunk = _trunk_path(skeleton)
    shortest = _MIN_BONE_STATURE * stature
    parts = [_trunk_part(trunk, at, ends, stature)] if trunk else []
    for joint, child in enumerate(main_children(skeleton)):
        if joint in trunk or (joint == 0 and has_floor_root(skeleton)):
            continue
        start, end, role = at[joint], ends[joint], split_side(skeleton.roles[joint])[1]
        if role == "Hips":
            parts.append(_ellipsoid(joint, start, np.eye(3), np.full(3, 0.09 * stature)))
        elif role == "Head":
            parts += _head_parts(joint, start, stature)
        elif role == "Hand" and child is None:
            parts += _hand_parts(joint, start, end, stature)
        elif role in ("Foot", "ToeBase"):
            parts += _foot_parts(joint, start, end, stature)
        elif np.linalg.norm(end - start) > shortest:
            first, last = _radii(skeleton, joint, child)
            parts.append(_capsule(joint, start, end, first * stature, last * stature))
    return parts


def _trunk_path(skeleton: SkeletonModel) -> list[int]:
    """Return the joints from the hips up to the neck's first joint; empty without hips or a joint above."""
    top = next((skeleton.index_of_role(r) for r in ("Neck", "Head", "Spine1") if r in skeleton.roles), None)
    hips = skeleton.index_of_role("Hips")
    if top is None or hips is None:
        return []
    path = [top]
    while path[-1] != hips and path[-1] > 0:
        path.append(int(skeleton.parents[path[-1]]))
    return path[:0:-1] if path[-1] == hips else []


def _radii(skeleton: SkeletonModel, joint: int, child: int | None) -> tuple[float, float]:
    """Return the radii at both ends of a bone, in statures."""

    def radius(index: int) -> float | None:
        return _RADIUS.get(split_side(skeleton.roles[index])[1])

    first = radius(joint)
    if skeleton.roles[joint] == "Neck":
        return 0.034, 0.032
    if first is None:  # a joint without a role, for example a twist joint or a finger
        above = radius(int(skeleton.parents[joint])) if joint else None
        first = above if above is not None and child is not None else _FREE_RADIUS
    last = None if child is None else radius(child)
    return first, 0.8 * first if last is None else last


def _tube(joint: int, centres: FloatArray, across: FloatArray) -> _Part:
    """Return a part from rings, of which the first and the last are single points.

    Args:
        joint: Index of the joint that the part moves with.
        centres: (R,3) centres of the rings.
        across: (R,2,3) half axes of the rings, metres; each second one is to the left of the first, as seen
            against the direction of the rings.
    """
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = centres[1:-1, None] + np.einsum("sk,rkc->rsc", circle, across[1:-1])
    vertices = np.concatenate([centres[:1], rings.reshape(-1, 3), centres[-1:]])
    return _Part(vertices, np.full((len(vertices), 2), joint), np.ones(len(vertices)))


def _faces(count: int) -> IntArray:
    """Return the triangles (F,3) of a tube with a number of vertices."""
    rings = (count - 2) // _SIDES
    here = 1 + np.arange(rings * _SIDES).reshape(rings, _SIDES)
    after = np.roll(here, -1, axis=1)
    low, high = here[:-1].ravel(), here[1:].ravel()
    low_next, high_next = after[:-1].ravel(), after[1:].ravel()
    first, last = np.zeros(_SIDES, dtype=np.int64), np.full(_SIDES, count - 1)
    return np.concatenate(
        [
            np.stack([first, after[0], here[0]], axis=1),
            np.stack([low, low_next, high], axis=1),
            np.stack([low_next, high_next, high], axis=1),
            np.stack([here[-1], after[-1], last], axis=1),
        ]
    )


def _normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return the unit normals (V,3) of vertices: the means of their faces' normals, weighted by area."""
    corners = vertices[faces]
    normals = np.zeros_like(vertices)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for corner in range(3):
        np.add.at(normals, faces[:, corner], areas)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


def _capsule(joint: int, start: FloatArray, end: FloatArray, first: float, last: float) -> _Part:
    """Return a cone with rounded ends, whose radius changes from `first` to `last` (metres)."""
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    axes = np.stack([side / np.linalg.norm(side), np.cross(along, side / np.linalg.norm(side))])
    angle = np.linspace(0.0, np.pi / 2.0, _CAP_RINGS + 1)
    centres = np.concatenate(
        [
            start - first * np.cos(angle)[:, None] * along,
            end + last * np.sin(angle)[:, None] * along,
        ]
    )
    radius = np.concatenate([first * np.sin(angle), last * np.cos(angle)])
    return _tube(joint, centres, radius[:, None, None] * axes)


def _ellipsoid(joint: int, centre: FloatArray, axes: FloatArray, radii: FloatArray) -> _Part:
    """Return an ellipsoid.

    Args:
        joint: Index of the joint that the part moves with.
        centre: (3,) centre.
        axes: (3,3) unit axes as columns, right-handed.
        radii: (3,) radii along the axes, metres.
    """
    angle = np.linspace(np.pi, 0.0, 2 * _CAP_RINGS + 1)
    centres = centre + radii[2] * np.cos(angle)[:, None] * axes[:, 2]
    return _tube(joint, centres, np.sin(angle)[:, None, None] * (axes[:, :2] * radii[:2]).T)


def _trunk_part(trunk: Sequence[int], at: FloatArray, ends: FloatArray, stature: float) -> _Part:
    """Return the trunk: a tube from below the hips to the neck, with the widths of `_TRUNK`.

    Its surface passes smoothly from joint to joint.
    """
    line = np.concatenate([at[list(trunk)], ends[trunk[-1]][None]])
    line[0] -= 0.4 * (line[1] - line[0])
    marks = np.cumsum([0.0, *np.linalg.norm(np.diff(line, axis=0), axis=1)])
    places = np.linspace(0.0, marks[-1], max(4, round(marks[-1] / (_TRUNK_RING_STATURE * stature))))
    centres = interpolated(places, marks, line)
    low, high = at[trunk[0]][2], max(line[-1][2], at[trunk[0]][2] + 0.28 * stature)
    fraction = (centres[:, 2] - low) / (high - low)
    radii = stature * interpolated(fraction, _TRUNK[:, 0], _TRUNK[:, 1:])
    angle = np.linspace(np.pi / 2.0, 0.0, _CAP_RINGS + 1)[:-1]
    caps = []
    for end, sign in ((0, -1.0), (-1, 1.0)):
        depth = 0.5 * radii[end].sum()
        height = sign * depth * np.sin(angle)
        caps.append(
            (centres[end] + height[:, None] * np.array([0.0, 0.0, 1.0]), np.cos(angle)[:, None] * radii[end])
        )
    (bottom, bottom_radii), (top, top_radii) = caps
    centres = np.concatenate([bottom, centres, top[::-1]])
    radii = np.concatenate([bottom_radii, radii, top_radii[::-1]])
    part = _tube(trunk[0], centres, radii[:, :, None] * np.eye(3)[:2])
    place = np.concatenate([np.zeros(len(bottom)), places, np.full(len(top), marks[-1])])
    ring = np.concatenate([[0], np.repeat(np.arange(1, len(place) - 1), _SIDES), [len(place) - 1]])
    joints, weights = part.joints.copy(), part.weights.copy()
    for parent, joint, mark in zip(trunk, trunk[1:], marks[1:], strict=False):
        t = np.clip(0.5 + (place[ring] - mark) / (2.0 * _BLEND_STATURE * stature), 0.0, 1.0)
        joints[t > 0.0] = [joint, parent]
        weights[t > 0.0] = (t * t * (3.0 - 2.0 * t))[t > 0.0]
    return _Part(part.vertices, joints, weights)


def _head_parts(joint: int, at: FloatArray, stature: float) -> list[_Part]:
    """Return the head, with a nose that shows where it looks."""
    skull = at + np.array([0.0, -0.006, 0.042]) * stature
    nose = at + np.array([0.0, -0.060, 0.026]) * stature
    return [
        _ellipsoid(joint, skull, np.eye(3), np.array([0.043, 0.055, 0.062]) * stature),
        _ellipsoid(joint, nose, np.eye(3), np.array([0.009, 0.013, 0.014]) * stature),
    ]


def _hand_parts(joint: int, at: FloatArray, end: FloatArray, stature: float) -> list[_Part]:
    """Return a flat hand with a thumb that points forward."""
    along = (end - at) / max(float(np.linalg.norm(end - at)), 1e-9)
    forward = np.array([0.0, -1.0, 0.0])
    forward = forward - (forward @ along) * along
    forward /= max(float(np.linalg.norm(forward)), 1e-9)
    axes = np.stack([forward, np.cross(along, forward), along], axis=1)
    length = min(float(np.linalg.norm(end - at)), 0.115 * stature)
    length = max(length, 0.06 * stature)
    radii = np.array([0.024 * stature, 0.0115 * stature, 0.56 * length])
    root = at + 0.22 * length * along + 0.012 * stature * forward
    tip = at + 0.50 * length * along + 0.036 * stature * forward
    return [
        _ellipsoid(joint, at + 0.46 * length * along, axes, radii),
        _capsule(joint, root, tip, 0.010 * stature, 0.007 * stature),
    ]


def _foot_parts(joint: int, at: FloatArray, end: FloatArray, stature: float) -> list[_Part]:
    """Return parts of a shoe: capsules from the heel to the bone's end, flat at the floor."""
    along = np.array([end[0] - at[0], end[1] - at[1], 0.0])
    length = float(np.linalg.norm(along))
    along = along / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])
    low = np.array([at[0], at[1], 0.0])
    tip = np.array([end[0], end[1], 0.0])
    up = np.array([0.0, 0.0, stature])
    if at[2] > 0.02 * stature:  # the foot: from the heel to the ball, and up to the ankle
        heel = low - 0.026 * stature * along + 0.016 * up
        arch = low + 0.45 * (tip - low) + 0.014 * up
        parts = [
            _capsule(joint, heel, tip + 0.010 * up, 0.024 * stature, 0.025 * stature),
            _capsule(joint, at, arch, 0.0235 * stature, 0.022 * stature),
        ]
    else:
        toe = low + max(length, 1e-3) * along + 0.007 * up
        parts = [_capsule(joint, low + 0.010 * up, toe, 0.025 * stature, 0.018 * stature)]
    for part in parts:
        part.vertices[:, 2] = np.maximum(part.vertices[:, 2], 0.0)
    return parts
