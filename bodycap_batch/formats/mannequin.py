"""A plain mannequin: a closed triangle mesh around the skeleton, whose vertices follow one or two joints.

The shape is a signed distance function: rounded cones along the bones and ellipsoids, joined smoothly. A grid
is laid over it, and the surface is read from the grid. All sizes follow the bones and the stature.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.formats.mannequin_pose import move_to_pose, with_arms_apart
from bodycap_batch.model.bone_axes import bone_ends_m, has_floor_root, main_children
from bodycap_batch.model.skeleton import SkeletonModel, rest_pose
from bodycap_batch.model.skeleton_presets import split_side

_GRID_STATURE = 1.0 / 80.0
"""Spacing of the grid in statures: 22 mm for a person of 1.75 m. Evidence: none; the mesh then has some 5,000
vertices, and a hand is two cells thick."""

_COARSE = 4
"""Spacing of the coarse grid in cells of the fine grid. Evidence: none."""

_BAND = 5.0
"""Distance from the surface, in cells of the fine grid, up to which the fine grid is evaluated. Derivation: a
point of the fine grid is at most 3.5 cells from the nearest point of the coarse grid."""

_REACH_M = 0.15
"""Distance (metres) from the sphere around a part beyond which the distance to the sphere replaces the
distance to the part. Derivation: it exceeds the band and the width of all smooth transitions."""

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
        [-0.10, 0.075, 0.056],
        [0.00, 0.090, 0.062],
        [0.30, 0.078, 0.053],
        [0.55, 0.090, 0.058],
        [0.80, 0.094, 0.058],
        [0.93, 0.070, 0.045],
        [1.00, 0.034, 0.034],
    ]
)
"""Half width and half depth of the trunk in statures. First column: place between hips (0) and neck (1).
Evidence: none; only the appearance depends on it."""

_BLEND_STATURE = 0.022
"""Width of the smooth transition between trunk and limbs, in statures. Evidence: none."""

_PROJECTIONS = 2
"""Number of Newton steps that move the vertices from the grid to the surface. Evidence: none; the vertices
then lie within a millimetre of it."""

_MAX_DISTANCE = 1e3
"""Distance (metres) that stands for "far away"."""

Field = Callable[[FloatArray], FloatArray]


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
    """A convex part of the body.

    Attributes:
        group: Name of the limb or the trunk; parts of one group are joined smoothly.
        joint: Index of the joint that the part moves with.
        distance: Function that returns the signed distance (N,) of points (N,3), metres.
    """

    group: str
    joint: int
    distance: Field


def make_mannequin(skeleton: SkeletonModel) -> Mannequin:
    """Return the mesh of a person with the skeleton's proportions.

    If the arms hang in the T-pose, the surface is made with the arms to the side, and is then moved back.

    Raises:
        ValueError: No bone has a length.
    """
    own = skeleton
    lengths = np.linalg.norm(np.concatenate([skeleton.offsets_m[1:], skeleton.end_offsets_m]), axis=1)
    if not np.nanmax(lengths, initial=0.0) > 0.0:
        raise ValueError("no bone has a length")
    skeleton = with_arms_apart(own)
    stature = _stature_m(skeleton)
    parts = _parts(skeleton, stature)
    distance = _body_field(parts, stature)
    spacing = stature * _GRID_STATURE
    vertices, faces = _surface(distance, _bounds(skeleton, stature), spacing)
    for _ in range(_PROJECTIONS):
        value, gradient = _value_and_gradient(distance, vertices, 0.1 * spacing)
        square = np.maximum(np.sum(gradient**2, axis=1), 0.1)
        vertices = vertices - (np.clip(value, -spacing, spacing) / square)[:, None] * gradient
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.0)  # the steps leave the sharp edge of the soles
    _, normals = _value_and_gradient(distance, vertices, 0.25 * spacing)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    joints, weights = _weights(skeleton, parts, vertices, stature)
    if skeleton is not own:
        vertices, normals = move_to_pose(skeleton, own, (vertices, normals), (joints, weights))
    return Mannequin(vertices_m=vertices, normals=normals, faces=faces, joints=joints, weights=weights)


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
    """Return the parts of the body: one for each bone with a length; more for head, hands and feet."""
    at, ends = rest_pose(skeleton)[:, :3, 3], bone_ends_m(skeleton)
    trunk, limbs = _trunk_path(skeleton), _limbs(skeleton)
    shortest = _MIN_BONE_STATURE * stature
    parts: list[_Part] = []
    for joint, child in enumerate(main_children(skeleton)):
        if joint == 0 and has_floor_root(skeleton):
            continue
        role = skeleton.roles[joint]
        if joint in trunk or role == "Hips":
            parts += _trunk_parts(joint, at, ends[joint], trunk, stature)
        elif role == "Head":
            parts += _head_parts(joint, at[joint], stature)
        elif split_side(role)[1] == "Hand" and child is None:
            parts += _hand_parts(joint, at[joint], ends[joint], limbs[joint], stature)
        elif split_side(role)[1] in ("Foot", "ToeBase"):
            parts += _foot_parts(joint, at[joint], ends[joint], limbs[joint], stature)
        elif np.linalg.norm(ends[joint] - at[joint]) > shortest:
            first, last = _radii(skeleton, joint, child)
            parts.append(
                _Part(limbs[joint], joint, _cone(at[joint], ends[joint], first * stature, last * stature))
            )
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


def _limbs(skeleton: SkeletonModel) -> list[str]:
    """Return the name of the limb that each joint belongs to: "LeftArm", "RightLeg", … or "Trunk"."""
    out: list[str] = []
    for joint, role in enumerate(skeleton.roles):
        side, part = split_side(role)
        if part in ("Shoulder", "Arm", "ForeArm", "Hand"):
            out.append(f"{side}Arm")
        elif part in ("UpLeg", "Leg", "Foot", "ToeBase"):
            out.append(f"{side}Leg")
        elif role or joint == 0:
            out.append("Trunk")
        else:
            out.append(out[int(skeleton.parents[joint])])
    return out


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


def _cone(start: FloatArray, end: FloatArray, first: float, last: float) -> Field:
    """Return the distance to a cone with rounded ends, whose radius changes from `first` to `last`."""
    along = end - start
    square = float(along @ along) or 1.0

    def distance(x: FloatArray) -> FloatArray:
        t = np.clip((x - start) @ along / square, 0.0, 1.0)
        off = x - start - t[:, None] * along
        return np.asarray(_norm(off) - (first + t * (last - first)))

    return _within(distance, (start + end) / 2.0, 0.5 * float(np.sqrt(square)) + max(first, last))


def _ellipsoid(centre: FloatArray, axes: FloatArray, radii: Sequence[float]) -> Field:
    """Return the approximate distance to an ellipsoid.

    Args:
        centre: (3,) centre.
        axes: (3,3) unit axes as columns.
        radii: Radii along the axes.
    """
    sizes = np.array(radii)

    def distance(x: FloatArray) -> FloatArray:
        local = (x - centre) @ axes
        near = _norm(local / sizes)
        slope = _norm(local / sizes**2)
        return np.asarray(np.where(slope > 1e-9, near * (near - 1.0) / np.maximum(slope, 1e-9), -sizes.min()))

    return _within(distance, centre, float(sizes.max()))


def _norm(vectors: FloatArray) -> FloatArray:
    """Return the lengths (N,) of vectors (N,3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _within(distance: Field, centre: FloatArray, radius: float) -> Field:
    """Return a distance that is exact near a sphere around a part, else the distance to the sphere."""
    reach = radius + _REACH_M

    def bounded(x: FloatArray) -> FloatArray:
        out = _norm(x - centre)
        near = out < reach
        out -= radius
        out[near] = distance(x[near])
        return out

    return bounded


def _trunk_parts(
    joint: int, at: FloatArray, end: FloatArray, trunk: Sequence[int], stature: float
) -> list[_Part]:
    """Return ellipsoids along the bone of a trunk joint, with the widths of `_TRUNK`."""
    if not trunk:
        return [_Part("Trunk", joint, _ellipsoid(at[joint], np.eye(3), [0.09 * stature] * 3))]
    first, low = at[joint], at[trunk[0]]
    high_z = max(float(end[2]), float(at[list(trunk)][:, 2].max()) + 1e-3)
    top = float(max(high_z, low[2] + 0.28 * stature))
    count = max(2, round(float(np.linalg.norm(end - first)) / (0.03 * stature)) + 1)
    places = np.linspace(-0.4 if joint == trunk[0] else 0.0, 1.0, count + (joint == trunk[0]))
    parts = []
    for place in places:
        centre = first + place * (end - first)
        fraction = (centre[2] - low[2]) / (top - low[2])
        wide, deep = (float(np.interp(fraction, _TRUNK[:, 0], _TRUNK[:, k])) * stature for k in (1, 2))
        parts.append(_Part("Trunk", joint, _ellipsoid(centre, np.eye(3), [wide, deep, 0.060 * stature])))
    return parts


def _head_parts(joint: int, at: FloatArray, stature: float) -> list[_Part]:
    """Return the head, with a nose that shows where it looks."""
    skull = at + np.array([0.0, -0.006, 0.042]) * stature
    nose = at + np.array([0.0, -0.060, 0.026]) * stature
    return [
        _Part(
            "Trunk", joint, _ellipsoid(skull, np.eye(3), [0.043 * stature, 0.055 * stature, 0.062 * stature])
        ),
        _Part(
            "Trunk", joint, _ellipsoid(nose, np.eye(3), [0.009 * stature, 0.013 * stature, 0.014 * stature])
        ),
    ]


def _hand_parts(joint: int, at: FloatArray, end: FloatArray, group: str, stature: float) -> list[_Part]:
    """Return a flat hand with a thumb that points forward."""
    along = (end - at) / max(float(np.linalg.norm(end - at)), 1e-9)
    forward = np.array([0.0, -1.0, 0.0])
    forward = forward - (forward @ along) * along
    forward /= max(float(np.linalg.norm(forward)), 1e-9)
    axes = np.stack([along, forward, np.cross(along, forward)], axis=1)
    length = min(float(np.linalg.norm(end - at)), 0.115 * stature)
    length = max(length, 0.06 * stature)
    palm = _ellipsoid(at + 0.52 * length * along, axes, [0.52 * length, 0.024 * stature, 0.0115 * stature])
    tip = at + (0.50 * length) * along + 0.036 * stature * forward
    thumb = _cone(
        at + 0.22 * length * along + 0.012 * stature * forward, tip, 0.010 * stature, 0.007 * stature
    )
    return [_Part(group, joint, palm), _Part(group, joint, thumb)]


def _foot_parts(joint: int, at: FloatArray, end: FloatArray, group: str, stature: float) -> list[_Part]:
    """Return a part of a shoe: a cone from the heel to the bone's end, cut off flat at the floor."""
    along = np.array([end[0] - at[0], end[1] - at[1], 0.0])
    length = float(np.linalg.norm(along))
    along = along / length if length > 1e-6 else np.array([0.0, -1.0, 0.0])
    low = np.array([at[0], at[1], 0.0])
    tip = np.array([end[0], end[1], 0.0])
    up = np.array([0.0, 0.0, stature])
    if at[2] > 0.02 * stature:  # the foot: from the heel to the ball, and up to the ankle
        heel = low - 0.026 * stature * along + 0.016 * up
        arch = low + 0.45 * (tip - low) + 0.014 * up
        sole = _cone(heel, tip + 0.010 * up, 0.024 * stature, 0.025 * stature)
        fields: list[Field] = [sole, _cone(at, arch, 0.0235 * stature, 0.022 * stature)]
    else:
        fields = [_cone(low + 0.010 * up, tip + 0.007 * up, 0.025 * stature, 0.018 * stature)]
    return [_Part(group, joint, _above_floor(field)) for field in fields]


def _above_floor(distance: Field) -> Field:
    """Return the distance to the part of a shape above the floor."""
    return lambda x: np.maximum(distance(x), -x[:, 2])


def _body_field(parts: Sequence[_Part], stature: float) -> Field:
    """Return the distance to the whole body: smooth inside a limb, and between the trunk and each limb."""
    width = _BLEND_STATURE * stature
    groups = list(dict.fromkeys(part.group for part in parts))

    def distance(x: FloatArray) -> FloatArray:
        found = {
            group: reduce(
                lambda a, b: _smooth_min(a, b, 0.5 * width),
                [part.distance(x) for part in parts if part.group == group],
            )
            for group in groups
        }
        limbs = [values for group, values in found.items() if group != "Trunk"]
        trunk = found.get("Trunk", np.full(len(x), _MAX_DISTANCE))
        joined = [_smooth_min(trunk, limb, width) for limb in limbs] or [trunk]
        return reduce(np.minimum, joined)

    return distance


def _smooth_min(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    """Return the smaller of two distances, with a smooth transition of the given width.

    Source: I. Quilez, "Smooth minimum", the quadratic polynomial.
    """
    near = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.asarray(np.minimum(a, b) - near * near * width / 4.0)


def _value_and_gradient(distance: Field, x: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return a distance (N,) and its gradient (N,3) at points (N,3), from forward differences."""
    value = distance(x)
    return value, np.stack([(distance(x + step * axis) - value) / step for axis in np.eye(3)], axis=1)


def _bounds(skeleton: SkeletonModel, stature: float) -> FloatArray:
    """Return the lowest and the highest corner (2,3) of a box around the body."""
    points = np.concatenate([rest_pose(skeleton)[:, :3, 3], bone_ends_m(skeleton)])
    if has_floor_root(skeleton):
        points = np.delete(points, [0, len(skeleton.joints)], axis=0)
    margin = 0.13 * stature
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def _surface(distance: Field, box: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """Return vertices (V,3) and triangles (F,3) of the surface where a distance is zero.

    Source: S. F. F. Gibson, "Constrained Elastic Surface Nets", MICCAI 1998: one vertex in each cell that the
    surface crosses, at the mean of the crossings of the cell's edges; one quadrilateral for each crossed
        edge.
    """
    axes = [np.arange(low, high + spacing, spacing) for low, high in box.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = _grid_values(distance, grid, spacing)
    inside = values < 0.0
    cells = tuple(size - 1 for size in values.shape)
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    edges = [(a, b) for a in corners for b in corners if a < b and sum(np.abs(np.subtract(a, b))) == 1]

    def at(corner: tuple[int, int, int]) -> tuple[slice, slice, slice]:
        i, j, k = (slice(c, c + size) for c, size in zip(corner, cells, strict=True))
        return i, j, k

    for a, b in edges:
        crossed = np.nonzero(inside[at(a)] != inside[at(b)])
        first, last = values[at(a)][crossed], values[at(b)][crossed]
        share = first / (first - last)
        total[crossed] += np.array(a) + share[:, None] * (np.array(b) - np.array(a))
        count[crossed] += 1.0
    used = count > 0
    number = np.full(cells, -1)
    number[used] = np.arange(int(used.sum()))
    vertices = grid[:-1, :-1, :-1][used] + spacing * total[used] / count[used][:, None]
    return vertices, np.concatenate([_quads(inside, number, axis) for axis in range(3)])


def _grid_values(distance: Field, grid: FloatArray, spacing: float) -> FloatArray:
    """Return the distance at a grid's points (X,Y,Z,3): exact near the surface, else from a coarse grid."""
    nearest = [
        np.minimum((np.arange(size) + _COARSE // 2) // _COARSE, (size - 1) // _COARSE)
        for size in grid.shape[:3]
    ]
    coarse = grid[::_COARSE, ::_COARSE, ::_COARSE]
    rough = distance(coarse.reshape(-1, 3)).reshape(coarse.shape[:3])
    values = np.array(rough[np.ix_(*nearest)])
    near = np.abs(values) < _BAND * spacing
    values[near] = distance(grid[near])
    return values


def _quads(inside: np.ndarray, number: IntArray, axis: int) -> IntArray:
    """Return the triangles (F,3) around the grid's edges along an axis that the surface crosses."""
    along = np.moveaxis(inside, axis, 0)
    cells = np.moveaxis(number, axis, 0)
    starts, ends = along[:-1, 1:-1, 1:-1], along[1:, 1:-1, 1:-1]
    around = [cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]]
    triangles = []
    # Moving the axis to the front turns the axes cyclically for X and Z, and mirrors them for Y.
    for leaves, flipped in ((starts & ~ends, axis == 1), (~starts & ends, axis != 1)):
        quad = np.stack([corner[leaves] for corner in around], axis=1)
        quad = quad[:, ::-1] if flipped else quad
        triangles += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(triangles)


def _weights(
    skeleton: SkeletonModel, parts: Sequence[_Part], vertices: FloatArray, stature: float
) -> tuple[IntArray, FloatArray]:
    """Return the two joints (V,2) that each vertex follows and their weights (V,2).

    A vertex belongs to the nearest part. Near a joint between two bones, its weight passes from one bone to
    the other across the plane that halves the angle between the bones.
    """
    distances = np.stack([part.distance(vertices) for part in parts])
    owner = np.array([part.joint for part in parts])[np.argmin(distances, axis=0)]
    rest = rest_pose(skeleton)
    at, ends = rest[:, :3, 3], bone_ends_m(skeleton)
    along = ends - at
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    with_parts = {part.joint for part in parts}
    joints = np.stack([owner, owner], axis=1)
    weights = np.tile([1.0, 0.0], (len(vertices), 1))
    nearest = np.full(len(vertices), np.inf)
    for child in range(1, len(skeleton.joints)):
        parent = int(skeleton.parents[child])
        if not {child, parent} <= with_parts:
            continue
        normal = along[parent] + along[child]
        length = float(np.linalg.norm(normal))
        normal = along[child] if length < 0.5 else normal / length
        radius = _blend_radius(skeleton, child) * stature
        ours = (owner == child) | (owner == parent)
        off = np.linalg.norm(vertices - at[child], axis=1)
        side = (vertices - at[child]) @ normal
        here = ours & (off < nearest) & (np.abs(side) < radius) & (off < 3.0 * radius)
        t = np.clip(0.5 + side[here] / (2.0 * radius), 0.0, 1.0)
        joints[here] = [child, parent]
        smooth = t * t * (3.0 - 2.0 * t)
        weights[here] = np.stack([smooth, 1.0 - smooth], axis=1)
        nearest[here] = off[here]
    return joints, weights


def _blend_radius(skeleton: SkeletonModel, joint: int) -> float:
    """Return half the width of the transition between the bones at a joint, in statures."""
    role = skeleton.roles[joint]
    part = split_side(role)[1]
    if part in _RADIUS:
        return 1.2 * _RADIUS[part]
    return 0.025 if role in ("Neck", "Head") else 0.035
