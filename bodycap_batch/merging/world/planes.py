"""The map's large planes: walls, floor, ceiling. They know the vertical better than a body does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp

PLANE_HALF_THICKNESS_M = 0.02
_MIN_POINTS = 100
_MIN_PLANE_POINTS = 25
_MAX_PLANES = 10
_HYPOTHESES = 600
_HYPOTHESES_AT_ONCE = 32
"""Hypotheses whose distances from all points are held at a time."""
_NEIGHBOUR_RADIUS_M = 1.5
_MAX_POINTS = 20_000
"""Points that tell as much as all: a long capture's map has hundreds of thousands."""
TILT_LIMIT_DEG = 20.0
"""How far the vertical may lie from the body's own: a chest's lean and its mount's error, three sigma."""
BENT_TILT_LIMIT_DEG = 35.0
"""The same of someone who mostly bends. At 45 a wall could pass for the floor."""
_AGREEMENT_DEG = 1.0
_MIN_INFORMATION_SHARE = 0.12
"""Smallest share of the planes' points that must fix each of the two tilts."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A plane of the map.

    Attributes:
        normal: (3,) unit.
        offset_m: ``normal @ x`` of its points.
        count: Points within `PLANE_HALF_THICKNESS_M`.
    """

    normal: FloatArray
    offset_m: float
    count: int


def find_planes(points_m: FloatArray, rng: np.random.Generator) -> list[Plane]:
    """Find planes one after the other, the fullest first.

    Args:
        points_m: (P,3).
        rng: Draws the hypotheses: a point and two of its neighbours.

    Source: M. A. Fischler, R. C. Bolles, "Random sample consensus", Communications of the ACM 24, 1981.
    """
    planes: list[Plane] = []
    if len(points_m) > _MAX_POINTS:
        points_m = points_m[rng.choice(len(points_m), _MAX_POINTS, replace=False)]
    left = points_m
    smallest = max(_MIN_PLANE_POINTS, round(0.03 * len(points_m)))
    while len(planes) < _MAX_PLANES and len(left) >= max(smallest, 4) and len(points_m) >= _MIN_POINTS:
        plane = _largest_plane(left, rng)
        if plane is None or plane.count < smallest:
            break
        planes.append(plane)
        left = left[np.abs(left @ plane.normal - plane.offset_m) > 2.0 * PLANE_HALF_THICKNESS_M]
    return planes


def _largest_plane(points: FloatArray, rng: np.random.Generator) -> Plane | None:
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
    # Three points in a line carry no plane.
    good = (
        length > 0.1 * np.linalg.norm(second - first, axis=1) * np.linalg.norm(third - first, axis=1) + 1e-12
    )
    if not good.any():
        return None
    normals, first = normals[good] / length[good, None], first[good]
    offsets = (normals * first).sum(axis=1)
    # All at once they take 60 MB for a walk of nine seconds, 200 with the most points there may be.
    parts = (
        slice(start, start + _HYPOTHESES_AT_ONCE) for start in range(0, len(normals), _HYPOTHESES_AT_ONCE)
    )
    counts = np.concatenate(
        [
            (np.abs(points @ normals[part].T - offsets[part]) < PLANE_HALF_THICKNESS_M).sum(axis=0)
            for part in parts
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
) -> tuple[FloatArray, float] | None:
    """The direction near the body's up that most planes are parallel or perpendicular to.

    Args:
        planes: From `find_planes`.
        body_up: (3,) where to look.
        limit_deg: How far from it.

    Returns:
        Up (3,) and the share of the planes' points that agree within `_AGREEMENT_DEG`, or None where the planes
        do not fix both tilts.
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
    return up, float(counts[agree].sum() / counts.sum())


def misalignment_deg(cosine: FloatArray) -> FloatArray:
    """Angle by which a plane is neither level nor upright."""
    angle = np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)))
    return np.asarray(np.minimum(angle, 90.0 - angle))


def _fixes_both_tilts(normals: FloatArray, counts: FloatArray, up: FloatArray, total: float) -> bool:
    information = np.zeros((3, 3))
    for normal, count in zip(normals, counts, strict=True):
        level = abs(float(normal @ up)) > 0.7
        information += count * (np.eye(3) - np.outer(up, up) if level else np.outer(normal, normal))
    basis = np.linalg.svd(up[None])[2][1:]
    return bool(np.linalg.eigvalsh(basis @ information @ basis.T)[0] > _MIN_INFORMATION_SHARE * total)
