"""From the solved frame (metres, arbitrary axes) to the world: which way is up, where the floor is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bodycap_batch.arrays import BoolArray, FloatArray
from bodycap_batch.geometry import Similarity, so3_exp
from bodycap_batch.merging.bones import Bone, proper_axes
from bodycap_batch.merging.planes import BENT_LIMIT_DEG, TILT_LIMIT_DEG, find_planes, vertical
from bodycap_batch.merging.posture import walking_plane
from bodycap_batch.merging.tracks import Track
from bodycap_batch.skeleton import Mount, SkeletonModel
from bodycap_batch.skeleton_presets import rest_positions, split_side

MOVING_M_PER_S = 0.4
WALKING_HEIGHT = 0.97
"""Mean height of the trunk in walking over its standing height: 0.95 to 1.00 on four captures."""

_USUAL_RAD = float(np.radians(15.0))
"""A trunk sways by less than this about its usual direction in walking and standing."""
_DIRECTIONS = 300
_FROM_MEAN = float(np.cos(np.radians(45.0)))
"""Of two directions at right angles one is nearer to the mean than this: further off, a wall passes for the
floor."""
SLAB_M = 0.03
_MIN_POINTS = 100
_MIN_FLOOR_POINTS = 30
_MOST_BELOW = 0.02
_FLOOR_REACH = 0.25
"""How far off the body's own idea of it the floor is looked for, as a share of the trunk's height."""
_BESIDE_M = 0.8
_WALKED_OVER = 5
"""A floor shows beside the walk, seen from above, in so many points of a slab, and in half of all there."""
_LEGLESS_HIP_M = 0.9
_ANKLE_OVER_LEG = 0.039 / 0.491
"""Ankle height over leg length (Drillis and Contini), for rigs whose feet end at the ankle."""


@dataclass(frozen=True, slots=True)
class BodyUp:
    """Where a body's trunk points.

    Attributes:
        usual: (3,) near which it is most of the time: who bends now and then is upright in between.
        mean: (3,) of all the time: who is bent most of the time leans less in the mean.
    """

    usual: FloatArray
    mean: FloatArray


@dataclass(frozen=True, slots=True)
class Direction:
    """Up in the solved frame, and what it rests on."""

    up: FloatArray
    source: str
    body_off_deg: float | None
    plane_share: float


@dataclass(frozen=True, slots=True)
class Floor:
    """Height of the floor along up, and what it rests on."""

    height_m: float
    source: str
    support: int


def body_up(skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray) -> BodyUp:
    """Up direction of a body: its trunk's axis as it usually is, else against its hanging limbs."""
    trunk = [i for i, bone in enumerate(bones) if not split_side(bone.role)[0]]
    limbs = [
        i for i, bone in enumerate(bones) if split_side(bone.role)[1] in ("Arm", "UpLeg", "Leg", "ForeArm")
    ]
    if trunk:
        return _over_time(world_from_bone[:, trunk, :3, 2].mean(axis=1))
    chosen = limbs or list(range(len(bones)))
    along = [world_from_bone[:, i, :3, :3] @ proper_axes(skeleton, bones[i].role)[:, 0] for i in chosen]
    hanging = _unit(-np.mean(along, axis=(0, 1)))
    return BodyUp(hanging, hanging)


def body_up_from_prior(bones: Sequence[Bone], trunk: Track, mount: Mount) -> BodyUp:
    """Up in the map that a camera's path and its mount's prior promise."""
    rest = np.eye(3)
    index = trunk.bone
    while bones[index].parent >= 0:
        rest = bones[index].mean_rotation.T @ rest
        index = bones[index].parent
    joint = trunk.map_from_cam[:, :3, :3] @ mount.joint_from_cam[:3, :3].T
    return _over_time((joint @ rest)[:, :, 2])


def _over_time(directions: FloatArray) -> BodyUp:
    return BodyUp(usual_direction(directions), _unit(directions.mean(axis=0)))


def _unit(direction: FloatArray) -> FloatArray:
    return np.asarray(direction / np.linalg.norm(direction))


def usual_direction(directions: FloatArray) -> FloatArray:
    """The direction (3,) near which most of (N,3) lie: who bends down is upright in between.

    The mean of a lifter's trunk leans by half of its bends.
    """
    some = directions[np.unique(np.linspace(0, len(directions) - 1, _DIRECTIONS).astype(np.int64))]
    some = some / np.linalg.norm(some, axis=1, keepdims=True)
    near = some @ some.T > np.cos(_USUAL_RAD)
    return _unit(some[near[int(np.argmax(near.sum(axis=1)))]].mean(axis=0))


def find_up(points_m: FloatArray, body: BodyUp, rng: np.random.Generator, path_m: FloatArray) -> Direction:
    """Turn the body's up onto the vertical of the map's walls, floor and ceiling, else of the walk.

    Looked for about both of the body's directions; found about both, the one nearer to the mean is it. Planes
    further off than an upright body's come after the walk: a wall and a sloping roof agree on a vertical
    too, and who walked level knows better.

    Args:
        points_m: (P,3) map points in the solved frame.
        body: The body's up.
        rng: Draws the planes' hypotheses.
        path_m: (N,3) path of the trunk's camera.
    """
    planes = find_planes(points_m, rng)

    def by_planes(limit_deg: float) -> Direction | None:
        return _nearest(body, "map", [vertical(planes, hint, limit_deg) for hint in (body.usual, body.mean)])

    def by_walk() -> Direction | None:
        walked = [walking_plane(path_m, hint) for hint in (body.usual, body.mean)]
        return _nearest(body, "walk", [None if up is None else (up, 0.0) for up in walked])

    return (
        by_planes(TILT_LIMIT_DEG)
        or by_walk()
        or by_planes(BENT_LIMIT_DEG)
        or Direction(body.usual, "body", None, 0.0)
    )


def _nearest(body: BodyUp, source: str, found: Sequence[tuple[FloatArray, float] | None]) -> Direction | None:
    """Of verticals and their planes' shares the one nearest to the body's mean, if near enough."""
    near = [each for each in found if each is not None and float(each[0] @ body.mean) > _FROM_MEAN]
    if not near:
        return None
    up, share = max(near, key=lambda each: float(each[0] @ body.mean))
    angle = float(np.degrees(np.arccos(np.clip(up @ body.usual, -1.0, 1.0))))
    return Direction(up, source, angle, share)


def find_floor(heights_m: FloatArray, up: Direction, expected_m: float, standing_m: float) -> Floor:
    """Find the floor among the heights (P,) of the map's points.

    The floor is a well-filled slab near where the standing body's soles are, with next to nothing below it.
    It is looked for only where the map itself gave the vertical: two degrees of tilt smear it over a
    decimetre.

    Args:
        heights_m: Along up.
        up: Where up came from.
        expected_m: Height of the soles from the body alone.
        standing_m: Height of a trunk joint above the soles; sets how far off the floor may be.
    """
    if up.source == "map" and len(heights_m) >= _MIN_POINTS:
        reach = _FLOOR_REACH * standing_m
        edges = np.arange(expected_m - reach, expected_m + reach, 0.25 * SLAB_M)
        inside = (heights_m >= edges[:, None]) & (heights_m < edges[:, None] + SLAB_M)
        below = (heights_m < edges[:, None] - 2.0 * SLAB_M).mean(axis=1)
        counts = np.where(below < _MOST_BELOW, inside.sum(axis=1), 0)
        best = int(np.argmax(counts))
        # Clutter spreads evenly over heights; a floor stands out from it.
        if counts[best] >= max(_MIN_FLOOR_POINTS, 3.0 * float(np.median(inside.sum(axis=1)))):
            slab = heights_m[np.abs(heights_m - edges[best] - 0.5 * SLAB_M) < SLAB_M]
            return Floor(float(np.median(slab)), "map", len(slab))
    return Floor(expected_m, "standing hip height", 0)


def walked_floor(
    points_m: FloatArray, path_m: FloatArray, up: Direction, expected_m: float, standing_m: float
) -> Floor | None:
    """Find the floor in the few points beside the walk: nobody walks through a table.

    Args:
        points_m: (P,3) map points in the solved frame.
        path_m: (N,3) path of the trunk.
        up: The vertical; two degrees of tilt smear a floor over a decimetre, so that only the map's will do.
        expected_m: Height of the soles from the body alone.
        standing_m: Height of a trunk joint above the soles; sets how far off the floor may be.
    """
    if up.source != "map" or not len(points_m):
        return None
    level = np.linalg.svd(up.up[None])[2][1:].T
    beside = cKDTree(path_m @ level).query(points_m @ level)[0] < _BESIDE_M
    heights = np.sort(points_m[beside] @ up.up)
    heights = heights[np.abs(heights - expected_m) < _FLOOR_REACH * standing_m]
    if not len(heights):
        return None
    ends = np.searchsorted(heights, heights + 2.0 * SLAB_M, side="right")
    first = int(np.argmax(ends - np.arange(len(heights))))
    slab = heights[first : ends[first]]
    if len(slab) < max(_WALKED_OVER, 0.5 * len(heights)):
        return None
    return Floor(float(np.median(slab)), "map", len(slab))


def feet_floor(skeleton: SkeletonModel, world_from_joint: FloatArray, solved: BoolArray) -> Floor | None:
    """Find the lowest height of the soles (Z up) where a foot was solved: the ankles' 2nd percentile."""
    ankles = [skeleton.index_of_role(side + "Foot") for side in ("Left", "Right")]
    heights = [world_from_joint[:, ankle, 2, 3] for ankle in ankles if ankle is not None and solved[ankle]]
    legs = leg_lengths(skeleton)
    if not heights or not legs:
        return None
    lowest = float(np.percentile(np.min(heights, axis=0), 2.0))
    return Floor(lowest - float(np.mean([ankle for _, _, ankle in legs])), "feet", 0)


def leg_lengths(skeleton: SkeletonModel) -> list[tuple[float, float, float]]:
    """Per leg: the root over the hip joint at zero pose, thigh and shin together, the ankle over the sole."""
    out = []
    rest = rest_positions(skeleton)
    for side in ("Left", "Right"):
        chain = [skeleton.index_of_role(side + part) for part in ("UpLeg", "Leg", "Foot")]
        if None in chain:
            continue
        hip, knee, ankle = (rest[joint] for joint in chain if joint is not None)
        leg = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        toe = skeleton.index_of_role(side + "ToeBase")
        drop = float(ankle[2] - rest[toe][2]) if toe is not None else 0.0
        out.append((float(rest[0][2] - hip[2]), leg, max(drop, _ANKLE_OVER_LEG * leg)))
    return out


def standing_height(skeleton: SkeletonModel, joint: int) -> float:
    """Height of a trunk joint over the soles with straight legs.

    A rig's zero pose may spread its legs and put its root anywhere: the bones' lengths are added up.
    """
    rest = rest_positions(skeleton)
    above_root = float(rest[joint][2] - rest[0][2])
    legs = leg_lengths(skeleton)
    if legs:
        return above_root + float(np.mean([sum(leg) for leg in legs]))
    return above_root + (float(rest[0][2]) if rest[0][2] > 0.3 else _LEGLESS_HIP_M)


def heading(forward: FloatArray, centre_m: FloatArray, fps: float) -> float:
    """Mean heading (rad, from +X towards +Y) of the body's forward over the first moving second.

    Args:
        forward: (T,3) the body's forward, Z up.
        centre_m: (T,3) where it is.
        fps: Ticks per second.
    """
    window, stride = max(round(fps), 1), max(round(0.25 * fps), 1)
    start = 0
    if len(centre_m) > stride:
        travelled = np.linalg.norm(centre_m[stride:, :2] - centre_m[:-stride, :2], axis=1)
        moving = np.flatnonzero(travelled > MOVING_M_PER_S * stride / fps)
        start = int(moving[0]) if len(moving) else 0
    mean = forward[start : start + window, :2].sum(axis=0)
    return float(np.arctan2(mean[1], mean[0]))


def upright(up: FloatArray) -> FloatArray:
    """The smallest rotation (3,3) that takes `up` to +Z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    norm = float(np.linalg.norm(axis))
    if norm < 1e-9:
        return np.eye(3) if up[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / norm * np.arctan2(norm, up[2]))


def place(rotation: FloatArray, hips_m: FloatArray, floor_m: float, heading_rad: float) -> Similarity:
    """The rigid motion from the solved frame to the world.

    Args:
        rotation: (3,3) that makes up +Z.
        hips_m: (3,) hips at tick 0, after `rotation`.
        floor_m: Height of the floor, after `rotation`.
        heading_rad: Heading of the first moving second, after `rotation`; becomes −Y.
    """
    turn = Rotation.from_euler("z", -0.5 * np.pi - heading_rad).as_matrix()
    origin = np.array([hips_m[0], hips_m[1], floor_m])
    return Similarity(1.0, turn @ rotation, -(turn @ origin))
