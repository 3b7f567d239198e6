"""The large planes of the map: walls, floor, ceiling. They give a more accurate vertical than the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.spatial import cKDTree

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp

PLANE_HALF_THICKNESS_M = 0.02
"""Maximum distance (metres) of a point from its plane; less if the points are more exact. Evidence:
docs/decisions/merging.md."""
_MIN_HALF_THICKNESS_M = 0.002
"""Smallest maximum distance (metres) of a point from its plane: walls are not flatter than that. Evidence:
none."""
_THICKNESS_SIGMAS = 1.96
"""Maximum distance of a point from its plane, in sigmas of the points of the largest plane. Derivation: 95 %
of the points of a plane are nearer."""
MIN_POINTS = 100
"""Minimum number of map points for a search for planes, or for the floor among all points. Evidence:
none."""
_MIN_PLANE_POINTS = 25
"""Minimum number of points of a plane. Evidence: none."""
_MIN_PLANE_SHARE = 0.03
"""Minimum number of points of a plane, as a fraction of all points. Evidence: none."""
_MAX_PLANES = 10
"""Maximum number of planes that are searched. Evidence: none."""
_HYPOTHESES = 600
"""Number of RANSAC hypotheses for each plane. Evidence: none."""
_REFINEMENTS = 5
"""Number of weighted fits of a plane to the points near it. Evidence: none."""
_HYPOTHESES_AT_ONCE = 32
"""Number of hypotheses that are compared with all points at the same time. It bounds the memory. Evidence:
docs/decisions/merging.md."""
_NEIGHBOUR_RADIUS_M = 1.5
"""Maximum distance (metres) from the first point of a hypothesis to its two other points. Neighbouring points
often lie on the same plane."""
_MAX_POINTS = 20_000
"""Maximum number of points that are used. The map of a long capture has hundreds of thousands of points."""
TILT_LIMIT_DEG = 20.0
"""Maximum angle (degrees) between the vertical and the body's up direction. It is three times the
combined sigma of two angles: the tilt of a chest, and the error of its camera's mount."""
BENT_TILT_LIMIT_DEG = 35.0
"""Maximum angle (degrees) between the vertical and the up direction of a person who bends most of the time.
The limit is less than 45 degrees, because a wall could otherwise be mistaken for the floor."""
_AGREEMENT_DEG = 1.0
"""Maximum misalignment (degrees) of a plane that agrees with a vertical. The misalignment is the angle by
which the plane deviates from horizontal or from vertical, whichever is smaller."""
_MIN_INFORMATION_SHARE = 0.06
"""Minimum information about the vertical, as a fraction of the number of points of all planes. The vertical
can tilt about two horizontal axes. The information about each of the two tilts must reach this minimum. A
point of a floor adds one unit to both tilts. A point of a wall adds one unit to one tilt. Evidence:
docs/decisions/merging.md."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane of the map.

    Attributes:
        normal: (3,) unit normal of the plane.
        offset_m: Signed distance of the plane from the origin: ``normal @ x`` for each point x of the plane.
        count: Number of map points within `PLANE_HALF_THICKNESS_M` of the plane.
    """

    normal: FloatArray
    offset_m: float
    count: int


@dataclass(frozen=True, slots=True)
class PlaneVertical:
    """A vertical to which most planes of the map are parallel or perpendicular.

    Attributes:
        up: (3,) unit vector that points up.
        inlier_share: Fraction of the planes' points that belong to planes with a misalignment of less than
            `_AGREEMENT_DEG`.
    """

    up: FloatArray
    inlier_share: float


def find_planes(points_m: FloatArray, rng: np.random.Generator) -> list[Plane]:
    """Find planes one after the other. Each time, find the plane with the most remaining points.

    Args:
        points_m: (P,3) map points, metres.
        rng: Random generator that draws the hypotheses. A hypothesis is a point and two of its neighbours.

    Source: M. A. Fischler, R. C. Bolles, "Random sample consensus", Communications of the ACM 24, 1981.
    """
    if len(points_m) > _MAX_POINTS:
        points_m = points_m[rng.choice(len(points_m), _MAX_POINTS, replace=False)]
    if len(points_m) < MIN_POINTS:
        return []
    smallest = max(_MIN_PLANE_POINTS, round(_MIN_PLANE_SHARE * len(points_m)))
    thickness_m = _thickness(points_m, _largest_plane(points_m, PLANE_HALF_THICKNESS_M, rng))
    planes: list[Plane] = []
    remaining = points_m
    while len(planes) < _MAX_PLANES and len(remaining) >= max(smallest, 4):
        plane = _largest_plane(remaining, thickness_m, rng)
        if plane is None or plane.count < smallest:
            break
        planes.append(plane)
        remaining = remaining[np.abs(remaining @ plane.normal - plane.offset_m) > 2.0 * thickness_m]
    return planes


def _thickness(points: FloatArray, plane: Plane | None) -> float:
    """Return the maximum distance (metres) of a point (P,3) from its plane, from the largest plane."""
    if plane is None:
        return PLANE_HALF_THICKNESS_M
    distance = np.abs(points @ plane.normal - plane.offset_m)
    sigma = 1.4826 * float(np.median(distance[distance < PLANE_HALF_THICKNESS_M]))
    return float(np.clip(_THICKNESS_SIGMAS * sigma, _MIN_HALF_THICKNESS_M, PLANE_HALF_THICKNESS_M))


def _largest_plane(points: FloatArray, thickness_m: float, rng: np.random.Generator) -> Plane | None:
    """Find the plane with the most points by RANSAC, and refine it by a fit to these points.

    Args:
        points: (P,3) points, metres.
        thickness_m: Maximum distance of a point from its plane, metres.
        rng: Random generator that draws the hypotheses.

    Returns:
        The plane; None if no three neighbouring points determine a plane with at least four points.
    """
    tree = cKDTree(points)
    seeds = rng.integers(len(points), size=_HYPOTHESES)
    groups = cast("list[list[int]]", tree.query_ball_point(points[seeds], _NEIGHBOUR_RADIUS_M))
    count = np.array([len(near) for near in groups])
    # Two different neighbours of each point.
    one = rng.integers(count)
    other = (one + rng.integers(1, np.maximum(count, 2))) % count
    triples = np.array(
        [
            [seed, near[a], near[b]]
            for seed, near, a, b in zip(seeds.tolist(), groups, one.tolist(), other.tolist(), strict=True)
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
    scores = np.concatenate(
        [_agreement(points @ normals[batch].T - offsets[batch], thickness_m).sum(axis=0) for batch in batches]
    )
    best = int(np.argmax(scores))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(_REFINEMENTS):
        weight = _agreement(points @ normal - offset, thickness_m)
        near = weight > 0.0
        if near.sum() < 4:
            return None
        centre = np.average(points[near], axis=0, weights=weight[near])
        root = np.sqrt(weight[near])[:, None]
        normal = np.linalg.svd(root * (points[near] - centre), full_matrices=False)[2][2]
        offset = float(centre @ normal)
    return Plane(normal, offset, int((np.abs(points @ normal - offset) < thickness_m).sum()))


def _agreement(distance_m: FloatArray, thickness_m: float) -> FloatArray:
    """Return how well points agree with a plane: 1 on the plane, 0 at the distance `thickness_m` and farther.

    The number of near points alone would prefer a plane that cuts through two parallel planes, such as a wall
    and the pictures on it, to either of them.

    Source: P. Torr, A. Zisserman, "MLESAC: a new robust estimator", Computer Vision and Image Understanding
    78, 2000 (there called MSAC).
    """
    return np.asarray(np.maximum(1.0 - (distance_m / thickness_m) ** 2, 0.0))


def vertical_from_planes(
    planes: Sequence[Plane], body_up: FloatArray, limit_deg: float
) -> PlaneVertical | None:
    """Find the vertical that agrees with most planes and is near the body's up direction.

    A plane agrees with a vertical if it is nearly parallel or perpendicular to this vertical.

    Args:
        planes: Planes of the map, from `find_planes`.
        body_up: (3,) up direction of the body, the centre of the search.
        limit_deg: Radius of the search in degrees.

    Returns:
        The vertical; None if there are no planes, or if the planes that agree do not determine its tilts
        about both horizontal axes.
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
    """Return how far (degrees) each plane deviates from horizontal or from vertical, whichever is smaller.

    Args:
        cosine: Cosine of the angle between each plane's normal and the vertical.
    """
    angle = np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)))
    return np.asarray(np.minimum(angle, 90.0 - angle))


def _fixes_both_tilts(normals: FloatArray, counts: FloatArray, up: FloatArray, total: float) -> bool:
    """Return whether planes determine the tilts of a vertical about both horizontal axes.

    Args:
        normals: (N,3) normals of the planes that agree with the vertical.
        counts: (N,) numbers of points of these planes.
        up: (3,) the vertical.
        total: Number of points of all planes, including planes that do not agree.
    """
    information = np.zeros((3, 3))
    for normal, count in zip(normals, counts, strict=True):
        level = abs(float(normal @ up)) > 0.7
        information += count * (np.eye(3) - np.outer(up, up) if level else np.outer(normal, normal))
    basis = np.linalg.svd(up[None])[2][1:]
    return bool(np.linalg.eigvalsh(basis @ information @ basis.T)[0] > _MIN_INFORMATION_SHARE * total)
