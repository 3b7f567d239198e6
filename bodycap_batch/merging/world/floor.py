"""The height of the floor, from the points of the map, from the feet, or from the standing body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.merging.world.planes import MIN_POINTS
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import ANKLE_OVER_LEG, rest_positions

WALKING_HEIGHT_RATIO = 0.97
"""Ratio of the trunk's mean height while walking to its standing height. Evidence:
docs/decisions/merging.md."""

SLAB_M = 0.03
"""Thickness (metres) of a horizontal slab in which points are counted. The slab of a found floor is twice as
thick. Evidence: none."""
_MIN_FLOOR_POINTS = 30
"""Minimum number of points in the slab of a floor. Evidence: none."""
_MIN_FLOOR_RATIO = 3.0
"""Minimum ratio of the number of points in the slab of a floor to the median number in all slabs. The points
of other objects are spread evenly over the heights. Evidence: none."""
_MAX_BELOW_RATIO = 0.2
"""Maximum ratio of the number of points below a floor to the number of points in the floor's slab. A table
top has a larger ratio, because the many points of the floor are below the table top. Evidence: none."""
_SEARCH_RATIO = 0.25
"""Maximum distance of the floor from its expected height, as a ratio to the trunk's standing height. The body
gives the expected height. Evidence: none."""
_PATH_DISTANCE_M = 0.8
"""Maximum horizontal distance (metres) of a point from the walked path. Within this distance, the person
walked on the floor. Evidence: none."""
_MIN_PATH_POINTS = 5
"""Minimum number of points near the path in the slab of a floor. Evidence: none."""
_MIN_PATH_SHARE = 0.5
"""Minimum fraction of the points near the path that lie in the slab of a floor. Only points at possible
heights of the floor are counted (see `_SEARCH_RATIO`). Evidence: none."""
_LEGLESS_HIP_M = 0.9
"""Assumed height (metres) of the hips above the floor, for a skeleton without legs. It is used only if the
zero pose does not give this height."""


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor.

    Attributes:
        height_m: Height of the floor along up, metres.
        source: Origin of the height: "map", "feet" or "standing hip height".
        support: Number of map points in the slab of the floor; 0 if the height does not come from the map.
    """

    height_m: float
    source: str
    support: int


def floor_from_points(heights_m: FloatArray, up: Vertical, expected_m: float, standing_m: float) -> Floor:
    """Find the floor among the heights of the map's points.

    The floor is a horizontal slab at about the height of the soles. Many points lie in this slab, and few
    points lie below it. The function searches for the slab only if the vertical comes from the map. Other
    verticals may be wrong by some degrees. An error of two degrees spreads the points of a floor over a
    decimetre.

    Args:
        heights_m: (P,) heights of the map's points along up, metres.
        up: The vertical.
        expected_m: Height of the soles according to the body, metres.
        standing_m: Height (metres) of a trunk joint above the soles. The search range is proportional to this
            height.

    Returns:
        The floor that was found in the map; otherwise a floor at the expected height.
    """
    if up.source == "map" and len(heights_m) >= MIN_POINTS:
        reach = _SEARCH_RATIO * standing_m
        edges = np.arange(expected_m - reach, expected_m + reach, 0.25 * SLAB_M)
        inside = (heights_m >= edges[:, None]) & (heights_m < edges[:, None] + SLAB_M)
        below = (heights_m < edges[:, None] - 2.0 * SLAB_M).sum(axis=1)
        counts = np.where(below < _MAX_BELOW_RATIO * inside.sum(axis=1), inside.sum(axis=1), 0)
        best = int(np.argmax(counts))
        if counts[best] >= max(_MIN_FLOOR_POINTS, _MIN_FLOOR_RATIO * float(np.median(inside.sum(axis=1)))):
            slab = heights_m[np.abs(heights_m - edges[best] - 0.5 * SLAB_M) < SLAB_M]
            return Floor(float(np.median(slab)), "map", len(slab))
    return Floor(expected_m, "standing hip height", 0)


def floor_beside_path(
    points_m: FloatArray, path_m: FloatArray, up: Vertical, expected_m: float, standing_m: float
) -> Floor | None:
    """Find the floor among the map points near the walked path, where no furniture can be.

    Args:
        points_m: (P,3) map points in the solved frame of reference.
        path_m: (N,3) positions of the trunk in the solved frame of reference.
        up: The vertical. It must come from the map, because a tilt of two degrees spreads the points of a
            floor over a decimetre.
        expected_m: Height of the soles according to the body, metres.
        standing_m: Height (metres) of a trunk joint above the soles. The search range is proportional to this
            height.

    Returns:
        The floor; None if the vertical does not come from the map, or if too few points lie at one height.
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
    if len(slab) < max(_MIN_PATH_POINTS, _MIN_PATH_SHARE * len(heights)):
        return None
    return Floor(float(np.median(slab)), "map", len(slab))


def floor_from_feet(skeleton: SkeletonModel, world_from_joint: FloatArray, solved: BoolArray) -> Floor | None:
    """Return the floor at the height of the lowest soles.

    The lowest position of the ankles is the 2nd percentile of their heights over time.

    Args:
        skeleton: The body.
        world_from_joint: (T,J,4,4) poses of the joints, z up.
        solved: (J,) whether each joint was solved.

    Returns:
        The floor; None if no ankle was solved, or if the skeleton has no complete leg.
    """
    ankles = [skeleton.index_of_role(side + "Foot") for side in ("Left", "Right")]
    heights = [world_from_joint[:, ankle, 2, 3] for ankle in ankles if ankle is not None and solved[ankle]]
    legs = _leg_heights(skeleton)
    if not heights or not legs:
        return None
    lowest = float(np.percentile(np.min(heights, axis=0), 2.0))
    return Floor(lowest - float(np.mean([ankle for _, ankle in legs])), "feet", 0)


def _leg_heights(skeleton: SkeletonModel) -> list[tuple[float, float]]:
    """Return the heights (metres) of root and ankle above the sole of each straight leg.

    A leg counts if the skeleton has its hip, its knee and its ankle.
    """
    out = []
    rest = rest_positions(skeleton)
    for side in ("Left", "Right"):
        chain = [skeleton.index_of_role(side + part) for part in ("UpLeg", "Leg", "Foot")]
        if None in chain:
            continue
        hip, knee, ankle = (rest[joint] for joint in chain if joint is not None)
        leg = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        toe = skeleton.index_of_role(side + "ToeBase")
        # In a skeleton whose feet end at the ankle, the length of the leg gives the height of the ankle.
        toe_drop = float(ankle[2] - rest[toe][2]) if toe is not None else 0.0
        ankle_height = max(toe_drop, ANKLE_OVER_LEG * leg)
        out.append((float(rest[0][2] - hip[2]) + leg + ankle_height, ankle_height))
    return out


def standing_height(skeleton: SkeletonModel, joint: int) -> float:
    """Return the height (metres) of a trunk joint above the soles of a person with straight legs.

    The height is the sum of the lengths of the bones. The zero pose of a skeleton does not give this height,
    because the legs may be spread and the root may be at any height.
    """
    rest = rest_positions(skeleton)
    above_root = float(rest[joint][2] - rest[0][2])
    legs = _leg_heights(skeleton)
    if legs:
        return above_root + float(np.mean([root for root, _ in legs]))
    return above_root + (float(rest[0][2]) if rest[0][2] > 0.3 else _LEGLESS_HIP_M)
