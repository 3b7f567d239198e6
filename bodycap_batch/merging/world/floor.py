"""From the solved frame (metres, arbitrary axes) to the world: where the floor is, which way ahead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions

MIN_MOVING_SPEED_M_PER_S = 0.4
WALKING_HEIGHT_RATIO = 0.97
"""Mean height of the trunk in walking over its standing height: 0.95 to 1.00 on four captures."""

SLAB_M = 0.03
_MIN_POINTS = 100
_MIN_FLOOR_POINTS = 30
_MAX_BELOW_RATIO = 0.2
"""Points below a floor over those in it: below what stands on a floor, the floor's own are more."""
_SEARCH_RATIO = 0.25
"""How far off the body's own idea of it the floor is looked for, as a share of the trunk's height."""
_PATH_DISTANCE_M = 0.8
_MIN_PATH_POINTS = 5
"""A floor shows beside the walk, seen from above, in so many points of a slab, and in half of all there."""
_LEGLESS_HIP_M = 0.9
_ANKLE_OVER_LEG = 0.039 / 0.491
"""Ankle height over leg length (Drillis and Contini), for rigs whose feet end at the ankle."""


@dataclass(frozen=True, slots=True)
class Floor:
    """Height of the floor along up, and what it rests on."""

    height_m: float
    source: str
    support: int


def floor_from_points(heights_m: FloatArray, up: Vertical, expected_m: float, standing_m: float) -> Floor:
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
        reach = _SEARCH_RATIO * standing_m
        edges = np.arange(expected_m - reach, expected_m + reach, 0.25 * SLAB_M)
        inside = (heights_m >= edges[:, None]) & (heights_m < edges[:, None] + SLAB_M)
        below = (heights_m < edges[:, None] - 2.0 * SLAB_M).sum(axis=1)
        counts = np.where(below < _MAX_BELOW_RATIO * inside.sum(axis=1), inside.sum(axis=1), 0)
        best = int(np.argmax(counts))
        # Clutter spreads evenly over heights; a floor stands out from it.
        if counts[best] >= max(_MIN_FLOOR_POINTS, 3.0 * float(np.median(inside.sum(axis=1)))):
            slab = heights_m[np.abs(heights_m - edges[best] - 0.5 * SLAB_M) < SLAB_M]
            return Floor(float(np.median(slab)), "map", len(slab))
    return Floor(expected_m, "standing hip height", 0)


def floor_beside_path(
    points_m: FloatArray, path_m: FloatArray, up: Vertical, expected_m: float, standing_m: float
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
    beside = cKDTree(path_m @ level).query(points_m @ level)[0] < _PATH_DISTANCE_M
    heights = np.sort(points_m[beside] @ up.up)
    heights = heights[np.abs(heights - expected_m) < _SEARCH_RATIO * standing_m]
    if not len(heights):
        return None
    ends = np.searchsorted(heights, heights + 2.0 * SLAB_M, side="right")
    first = int(np.argmax(ends - np.arange(len(heights))))
    slab = heights[first : ends[first]]
    if len(slab) < max(_MIN_PATH_POINTS, 0.5 * len(heights)):
        return None
    return Floor(float(np.median(slab)), "map", len(slab))


def floor_from_feet(skeleton: SkeletonModel, world_from_joint: FloatArray, solved: BoolArray) -> Floor | None:
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


def initial_heading(forward: FloatArray, centre_m: FloatArray, fps: float) -> float:
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
        moving = np.flatnonzero(travelled > MIN_MOVING_SPEED_M_PER_S * stride / fps)
        start = int(moving[0]) if len(moving) else 0
    mean = forward[start : start + window, :2].sum(axis=0)
    return float(np.arctan2(mean[1], mean[0]))


def rotation_to_z_up(up: FloatArray) -> FloatArray:
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
