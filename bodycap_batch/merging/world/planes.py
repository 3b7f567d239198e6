"""The large planes of the map: walls, floor, ceiling. Their vertical is more accurate than the body's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp

PLANE_HALF_THICKNESS_M = 0.02
"""Largest distance in metres of a plane's points from it. Evidence: none."""
_MIN_POINTS = 100
"""Points of a map below which no planes are searched. Evidence: none."""
_MIN_PLANE_POINTS = 25
"""Smallest number of points of a plane. Evidence: none."""
_MIN_PLANE_SHARE = 0.03
"""The same as a ratio of all points. Evidence: none."""
_MAX_PLANES = 10
"""Planes that are searched at most. Evidence: none."""
_HYPOTHESES = 600
"""RANSAC hypotheses for each plane. Evidence: none."""
_HYPOTHESES_AT_ONCE = 32
"""Hypotheses whose distances from all points are in memory at the same time. Evidence:
docs/decisions/merging.md."""
_NEIGHBOUR_RADIUS_M = 1.5
"""Largest distance in metres between the points of a hypothesis: neighbours often lie on one plane."""
_MAX_POINTS = 20_000
"""Points that are used at most; the map of a long capture has hundreds of thousands."""
TILT_LIMIT_DEG = 20.0
"""Largest angle in degrees between the vertical and the body's: three sigmas of a chest's lean and of the
error of its mount."""
BENT_TILT_LIMIT_DEG = 35.0
"""The same for a person who bends most of the time. At 45 degrees, a wall could be taken for the floor."""
_AGREEMENT_DEG = 1.0
"""Largest angle in degrees by which a plane that agrees with a vertical may be neither level nor upright."""
_MIN_INFORMATION_SHARE = 0.12
"""Smallest ratio of the planes' points that must determine each of the two tilts. Evidence: none."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane of the map.

    Attributes:
        normal: (3,) unit vector.
        offset_m: ``normal @ x`` of its points.
        count: Number of points within `PLANE_HALF_THICKNESS_M`.
    """

    normal: FloatArray
    offset_m: float
    count: int


@dataclass(frozen=True, slots=True)
class PlaneVertical:
    """A vertical to which planes of the map are parallel or perpendicular.

    Attributes:
        up: (3,) unit vector.
        inlier_share: Ratio of the planes' points that belong to planes within `_AGREEMENT_DEG`.
    """

    up: FloatArray
    inlier_share: float


def find_planes(points_m: FloatArray, rng: np.random.Generator) -> list[Plane]:
    """Find planes one after the other, those with most points first.

    Args:
        points_m: (P,3).
        rng: Draws the hypotheses: a point and two of its neighbours.

    Source: M. A. Fischler, R. C. Bolles, "Random sample consensus", Communications of the ACM 24, 1981.
    """
    planes: list[Plane] = []
    if len(points_m) > _MAX_POINTS:
        points_m = points_m[rng.choice(len(points_m), _MAX_POINTS, replace=False)]
    remaining = points_m
    smallest = max(_MIN_PLANE_POINTS, round(_MIN_PLANE_SHARE * len(points_m)))
    while len(planes) < _MAX_PLANES and len(remaining) >= max(smallest, 4) and len(points_m) >= _MIN_POINTS:
        plane = _largest_plane(remaining, rng)
        if plane is None or plane.count < smallest:
            break
        planes.append(plane)
        remaining = remaining[
            np.abs(remaining @ plane.normal - plane.offset_m) > 2.0 * PLANE_HALF_THICKNESS_M
        ]
    return planes


def _largest_plane(points: FloatArray, rng: np.random.Generator) -> Plane | None:
    """Return the plane with most points (P,3) by RANSAC, refined to them; None without three neighbours."""
    tree = cKDTree(points)
    seeds = rng.integers(len(points), size=_HYPOTHESES)
    groups = (np.array(tree.query_ball_point(point, _NEIGHBOUR_RADIUS_M)) for point in points[seeds])
    triples = np.array(
        [
            [seed, *rng.choice(near, 2, replace=False)]
            for seed, near in zip(seeds.tolist(), groups, strict=True)
            if len(near) > 3
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    if not len(triples):
        return None
    first, second, third = (points[triples[:, column]] for column in range(3))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1)
    # Three collinear points determine no plane.
    good = (
        length > 0.1 * np.linalg.norm(second - first, axis=1) * np.linalg.norm(third - first, axis=1) + 1e-12
    )
    if not good.any():
        return None
    normals, first = normals[good] / length[good, None], first[good]
    offsets = (normals * first).sum(axis=1)
    batches = (
        slice(start, start + _HYPOTHESES_AT_ONCE) for start in range(0, len(normals), _HYPOTHESES_AT_ONCE)
    )
    counts = np.concatenate(
        [
            (np.abs(points @ normals[batch].T - offsets[batch]) < PLANE_HALF_THICKNESS_M).sum(axis=0)
            for batch in batches
        ]
    )
    best = int(np.argmax(counts))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        inliers = points[np.abs(points @ normal - offset) < PLANE_HALF_THICKNESS_M]
        if len(inliers) < 4:
            return None
        normal = np.linalg.svd(inliers - inliers.mean(axis=0), full_matrices=False)[2][2]
        offset = float(inliers.mean(axis=0) @ normal)
    return Plane(normal, offset, int((np.abs(points @ normal - offset) < PLANE_HALF_THICKNESS_M).sum()))


def vertical_from_planes(
    planes: Sequence[Plane], body_up: FloatArray, limit_deg: float
) -> PlaneVertical | None:
    """Return the direction near the body's up that most planes are parallel or perpendicular to.

    Args:
        planes: From `find_planes`.
        body_up: (3,) centre of the search.
        limit_deg: Radius of the search.

    Returns:
        None if the planes that agree do not determine both tilts.
    """
    if not planes:
        return None
    normals = np.array([plane.normal for plane in planes])
    counts = np.array([plane.count for plane in planes], dtype=np.float64)
    first, second = np.linalg.svd(body_up[None])[2][1:]
    centre, tilt = np.zeros(2), limit_deg
    for _ in range(4):
        grid = np.linspace(-tilt, tilt, 41)
        offsets = centre + np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        offsets = offsets[np.hypot(*offsets.T) <= limit_deg]
        ups = so3_exp(np.radians(offsets[:, :1] * first + offsets[:, 1:] * second)) @ body_up
        scores = np.exp(-0.5 * (misalignment_deg(ups @ normals.T) / _AGREEMENT_DEG) ** 2) @ counts
        centre = offsets[int(np.argmax(scores))]
        tilt *= 0.1
    up = np.asarray(so3_exp(np.radians(centre[0] * first + centre[1] * second)) @ body_up)
    agree = misalignment_deg(up @ normals.T) < _AGREEMENT_DEG
    if not _fixes_both_tilts(normals[agree], counts[agree], up, counts.sum()):
        return None
    return PlaneVertical(up, float(counts[agree].sum() / counts.sum()))


def misalignment_deg(cosine: FloatArray) -> FloatArray:
    """Return the angle (degrees) by which planes are neither level nor upright.

    Args:
        cosine: Of the angle between each normal and the vertical.
    """
    angle = np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)))
    return np.asarray(np.minimum(angle, 90.0 - angle))


def _fixes_both_tilts(normals: FloatArray, counts: FloatArray, up: FloatArray, total: float) -> bool:
    """Return whether planes determine both tilts of a vertical.

    Args:
        normals: (N,3) of the planes that agree with it.
        counts: (N,) their points.
        up: (3,) the vertical.
        total: Points of all planes.
    """
    information = np.zeros((3, 3))
    for normal, count in zip(normals, counts, strict=True):
        level = abs(float(normal @ up)) > 0.7
        information += count * (np.eye(3) - np.outer(up, up) if level else np.outer(normal, normal))
    basis = np.linalg.svd(up[None])[2][1:]
    return bool(np.linalg.eigvalsh(basis @ information @ basis.T)[0] > _MIN_INFORMATION_SHARE * total)
