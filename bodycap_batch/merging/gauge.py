"""From the solved frame (metres, arbitrary axes) to the world: which way is up, where the floor is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.arrays import FloatArray
from bodycap_batch.geometry import Similarity, so3_exp
from bodycap_batch.merging.bones import Bone, proper_axes
from bodycap_batch.skeleton import SkeletonModel
from bodycap_batch.skeleton_presets import rest_positions, split_side

MOVING_M_PER_S = 0.4
WALKING_HEIGHT = 0.98
"""Mean hip height in walking over standing hip height."""

_SLAB_M = 0.03
_TILT_LIMIT_DEG = 25.0
_MIN_POINTS = 200
_MIN_CONTRAST = 1.5
"""How much fuller the map's horizontal slabs must be at the best direction than at a typical one."""
_ANKLE_OVER_LEG = 0.039 / 0.491
"""Ankle height over leg length (Drillis and Contini), for rigs whose feet end at the ankle."""


@dataclass(frozen=True, slots=True)
class Direction:
    """Up in the solved frame, and what it rests on."""

    up: FloatArray
    source: str
    body_disagreement_deg: float
    contrast: float


@dataclass(frozen=True, slots=True)
class Floor:
    """Height of the floor along up, and what it rests on."""

    height_m: float
    source: str
    support: int


def body_up(skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray) -> FloatArray:
    """Mean up direction (3,) of an upright body: its trunk's axis, else against its hanging limbs."""
    trunk = [i for i, bone in enumerate(bones) if not split_side(bone.role)[0]]
    limbs = [
        i for i, bone in enumerate(bones) if split_side(bone.role)[1] in ("Arm", "UpLeg", "Leg", "ForeArm")
    ]
    if trunk:
        direction = world_from_bone[:, trunk, :3, 2].mean(axis=(0, 1))
    else:
        chosen = limbs or list(range(len(bones)))
        along = [world_from_bone[:, i, :3, :3] @ proper_axes(skeleton, bones[i].role)[:, 0] for i in chosen]
        direction = -np.mean(along, axis=(0, 1))
    return np.asarray(direction / np.linalg.norm(direction))


def refine_up(points_m: FloatArray, body: FloatArray, rng: np.random.Generator) -> Direction:
    """Turn the body's up onto the map's horizontal surfaces where it shows them.

    Floor, ceiling and table tops fill thin slabs of height when looked at along the vertical; the direction
    within `_TILT_LIMIT_DEG` of the body's that fills the fullest slabs wins, if it stands out.

    Args:
        points_m: (P,3) map points in the solved frame.
        body: (3,) the body's up.
        rng: Picks a subset of large maps.
    """
    if len(points_m) < _MIN_POINTS:
        return Direction(body, "body", 0.0, 0.0)
    points = points_m if len(points_m) <= 6000 else rng.choice(points_m, 6000, replace=False)
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < 12.0]
    first, second = np.linalg.svd(body[None])[2][1:]
    centre, typical, tilt = np.zeros(2), 0.0, _TILT_LIMIT_DEG
    best = 0.0
    for _ in range(4):
        grid = np.linspace(-tilt, tilt, 21)
        offsets = centre + np.array([(x, y) for x in grid for y in grid])
        offsets = offsets[np.hypot(*offsets.T) <= _TILT_LIMIT_DEG]
        scores = np.array([_slab_score(points @ _tilted(body, first, second, pair)) for pair in offsets])
        typical = typical or float(np.median(scores))
        centre, best = offsets[int(np.argmax(scores))], float(scores.max())
        tilt *= 0.2
    angle = float(np.hypot(*centre))
    if best < _MIN_CONTRAST * typical or angle > 0.9 * _TILT_LIMIT_DEG:
        return Direction(body, "body", angle, best / typical)
    return Direction(_tilted(body, first, second, centre), "map", angle, best / typical)


def _tilted(body: FloatArray, first: FloatArray, second: FloatArray, degrees: FloatArray) -> FloatArray:
    return np.asarray(so3_exp(np.radians(degrees[0]) * first + np.radians(degrees[1]) * second) @ body)


def _slab_score(height: FloatArray) -> float:
    bins = np.bincount(np.floor((height - height.min()) / _SLAB_M).astype(np.int64))
    # Neighbouring bins together: a surface may straddle a border.
    pairs = bins[:-1] + bins[1:] if len(bins) > 1 else bins
    return float((pairs.astype(np.float64) ** 2).sum() / len(height) ** 2)


def find_floor(heights_m: FloatArray, expected_m: float, standing_m: float) -> Floor:
    """Find the floor among the heights (P,) of the map's points.

    The floor is a well-filled slab near where the standing body's soles are, with next to nothing below it.

    Args:
        heights_m: Along up.
        expected_m: Height of the soles from the body alone.
        standing_m: Height of the hips above the soles; sets how far off the floor may be.
    """
    if len(heights_m) >= _MIN_POINTS:
        reach = 0.3 * standing_m
        edges = np.arange(expected_m - reach, expected_m + reach, 0.5 * _SLAB_M)
        counts = np.array([((heights_m >= e) & (heights_m < e + _SLAB_M)).sum() for e in edges])
        below = np.array([(heights_m < e - 2.0 * _SLAB_M).mean() for e in edges])
        enough = max(25, 0.01 * len(heights_m))
        good = (counts >= enough) & (below < 0.03)
        if good.any():
            best = int(np.argmax(np.where(good, counts, 0)))
            slab = heights_m[np.abs(heights_m - edges[best] - 0.5 * _SLAB_M) < _SLAB_M]
            return Floor(float(np.median(slab)), "map", len(slab))
    return Floor(expected_m, "standing hip height", 0)


def standing_hip_height(skeleton: SkeletonModel) -> float:
    """Height of the root joint over the soles with straight legs.

    A rig's zero pose may spread its legs and put its root anywhere: the bones' lengths are added up.
    """
    heights = []
    rest = rest_positions(skeleton)
    for side in ("Left", "Right"):
        chain = [skeleton.index_of_role(side + part) for part in ("UpLeg", "Leg", "Foot")]
        if None in chain:
            continue
        hip, knee, ankle = (rest[joint] for joint in chain if joint is not None)
        leg = float(np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        toe = skeleton.index_of_role(side + "ToeBase")
        drop = float(ankle[2] - rest[toe][2]) if toe is not None else 0.0
        heights.append(float(rest[0][2] - hip[2]) + leg + max(drop, _ANKLE_OVER_LEG * leg))
    if heights:
        return float(np.mean(heights))
    return float(rest[0][2]) if rest[0][2] > 0.3 else 0.9


def heading(forward: FloatArray, centre_m: FloatArray, fps: float) -> float:
    """Mean heading (rad, from +X towards +Y) of the body's forward over the first moving second.

    Args:
        forward: (T,3) the body's forward, Z up.
        centre_m: (T,3) where it is.
        fps: Ticks per second.
    """
    window = max(round(fps), 1)
    start = 0
    if len(centre_m) > window:
        travelled = np.linalg.norm(centre_m[window:, :2] - centre_m[:-window, :2], axis=1)
        moving = np.flatnonzero(travelled > MOVING_M_PER_S * window / fps)
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
