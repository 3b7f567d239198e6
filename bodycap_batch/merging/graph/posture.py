"""Knowledge about the posture before the motion is solved: walking and its direction, standing, T-pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.merging.body.trunk_lean import MAX_SAMPLES
from bodycap_batch.merging.cameras.track import CameraTrack

MIN_WALKING_SPEED_M_PER_S = 0.5
"""Minimum horizontal speed (m/s) of the trunk in walking. Evidence: none."""
_STEP_NS = 500_000_000
"""Duration (nanoseconds) over which the velocity is computed. It is about the duration of one step. A
velocity over a shorter duration would contain the sway of the trunk within a step."""
_HIGHEST_PERCENTILE, _LOW_PERCENTILE = 95.0, 25.0
"""Percentiles of the trunk's height that are used as its highest position and as a low position. Evidence:
none."""
_STANDING_DROP_M = 0.02
"""While a person stands, the chest is at most this far (metres) below the highest position of the chest. A
chest half a metre above the hips is 2 cm lower if the trunk bends by 16 degrees."""
_MIN_WALKING_SHARE = 0.125
"""A capture with a smaller fraction of walking ticks is treated as a capture without walking. The person then
only steps aside during other work, mostly with a bent trunk. Unit: 1. Evidence: none."""
_BENT_DROP_M = 0.12
"""Difference of the chest's height (metres) that shows a bent trunk or bent knees. In walking, the person is
bent if the chest is lower than its usual height by more than this difference. In normal walking, the chest's
height varies by 5 cm. A capture without walking has standing ticks only if the height varies by more than
this difference."""
_MAX_HEADING_CHANGE_RAD = float(np.radians(35.0))
"""The angle between the camera's heading and the direction of walking has a usual value in a capture. If the
angle differs from this value by this threshold (radians) or more, the person is not treated as walking
forward. Evidence: none."""
_BOUNCE_M = 0.03
"""Scale (metres) of the robust weight of a point of a path, by its distance from the fitted horizontal plane.
The height of a walking trunk varies by 4 to 5 cm from the lowest to the highest position."""
_MIN_LEVEL_SHARE = 0.6
"""A path gives no vertical if a smaller fraction of its points lies in one horizontal plane. Unit: 1.
Evidence: none."""
_MIN_LEVEL_POINTS = 30
"""A path gives no vertical if fewer of its points lie in one horizontal plane. Evidence: none."""
_MIN_PATH_WIDTH_M = 0.3
"""A path gives no vertical if its standard deviation across its main direction is smaller (metres). At 0.3 m,
ten steps with a bounce of 2 cm tilt the fitted plane by one degree."""
_MAX_BODY_ANGLE_RAD = float(np.radians(30.0))
"""Maximum angle (radians) between the path's vertical and the body's vertical. Evidence: none."""
_STEP_M = 0.7
"""Length (metres) of a path over which the height of a walking trunk varies once. Derivation: a step."""
_FIT_ITERATIONS = 15
"""Number of iterations of the robust fit of a path's plane. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Posture:
    """Knowledge about the posture at K sampled ticks.

    Attributes:
        up: (3,) vertical in the map; None if it is unknown, or known only from the posture itself.
        walking: (K,) whether the person walks.
        walking_direction: (K,3) horizontal direction of walking; NaN where the person does not walk forward.
        t_pose: (K,) whether the person holds a T-pose.
        standing: (K,) whether the trunk is near its highest position in the capture. It is False for all
            ticks if the person walks in the capture.
    """

    up: FloatArray | None
    walking: BoolArray
    walking_direction: FloatArray
    t_pose: BoolArray
    standing: BoolArray

    @staticmethod
    def unknown(count: int) -> Posture:
        """Return a posture about which nothing is known, for `count` ticks."""
        none = np.zeros(count, dtype=bool)
        return Posture(
            up=None, walking=none, walking_direction=np.full((count, 3), np.nan), t_pose=none, standing=none
        )


def find_posture(
    track: CameraTrack, times_ns: IntArray, up: FloatArray | None, t_pose_ns: tuple[int, int] | None
) -> Posture:
    """Detect walking, standing and the T-pose at sampled times.

    Args:
        track: Track of the trunk's camera in metres; a provisional scale is accurate enough.
        times_ns: (K,) sampled times.
        up: (3,) vertical in the map; None if it is unknown.
        t_pose_ns: First and last time of a T-pose; None without a T-pose.
    """
    posture = Posture.unknown(len(times_ns))
    if t_pose_ns is not None:
        posture = replace(posture, t_pose=(times_ns >= t_pose_ns[0]) & (times_ns <= t_pose_ns[1]))
    if up is None:
        return posture
    half_step = _STEP_NS // 2
    before, after = (track.poses_at(times_ns + sign * half_step, max_gap_ns=_STEP_NS) for sign in (-1, 1))
    velocity = (after[0] - before[0])[:, :3, 3] / (1e-9 * _STEP_NS)
    velocity -= np.outer(velocity @ up, up)
    speed = np.linalg.norm(velocity, axis=1)
    moving = before[1] & after[1] & (speed > MIN_WALKING_SPEED_M_PER_S)
    direction = np.where(moving[:, None], velocity / np.maximum(speed, 1e-9)[:, None], np.nan)
    poses, _ = track.poses_at(times_ns, max_gap_ns=_STEP_NS)
    height_m = poses[:, :3, 3] @ up
    moving &= height_m > np.percentile(height_m[moving], 75.0) - _BENT_DROP_M if moving.any() else False
    walking = moving & _faces_walking_direction(poses[:, :3, :3], direction, up)
    if walking.sum() < max(5, 0.5 * moving.sum()):
        # More than half of the steps go sideways or backward, so the path does not show the heading.
        walking, direction = moving, np.full_like(direction, np.nan)
    if walking.mean() < _MIN_WALKING_SHARE:
        walking = np.zeros_like(walking)
    standing = np.zeros_like(walking) if walking.any() else _standing_ticks(track, height_m, up)
    return replace(
        posture,
        up=up,
        walking=walking,
        walking_direction=np.where(walking[:, None], direction, np.nan),
        standing=standing & ~posture.t_pose,
    )


def is_mostly_walking(track: CameraTrack) -> bool:
    """Return whether the trunk's camera moves at walking speed for more than half of the time.

    Args:
        track: Track of the trunk's camera in metres.
    """
    times_ns = track.times_ns[evenly_spaced(len(track.times_ns), MAX_SAMPLES)]
    half_step = _STEP_NS // 2
    before, after = (track.poses_at(times_ns + sign * half_step, max_gap_ns=_STEP_NS) for sign in (-1, 1))
    speed = np.linalg.norm((after[0] - before[0])[:, :3, 3], axis=1) / (1e-9 * _STEP_NS)
    return bool((before[1] & after[1] & (speed > MIN_WALKING_SPEED_M_PER_S)).mean() > 0.5)


def _standing_ticks(track: CameraTrack, height_m: FloatArray, up: FloatArray) -> BoolArray:
    """Return at which ticks (K,) the trunk is near its maximum height, if its height varies enough.

    If the height hardly varies, the person may sit or lean on something all the time. No tick is then treated
    as standing.

    Args:
        track: Track of the trunk's camera in metres.
        height_m: (K,) heights of the camera along up.
        up: (3,) vertical in the map.
    """
    low, highest = np.percentile(track.map_from_cam[:, :3, 3] @ up, [_LOW_PERCENTILE, _HIGHEST_PERCENTILE])
    return np.asarray((height_m > highest - _STANDING_DROP_M) & (highest - low > _BENT_DROP_M))


def _faces_walking_direction(rotation: FloatArray, direction: FloatArray, up: FloatArray) -> BoolArray:
    """Return at which ticks (T,) the camera's heading has its usual angle to the direction of walking.

    Args:
        rotation: (T,3,3) rotations map_from_cam.
        direction: (T,3) directions of walking, NaN where unknown.
        up: (3,) vertical in the map.
    """
    level = rotation - up[:, None] * np.einsum("i,tij->tj", up, rotation)[:, None, :]
    axis = level[:, :, int(np.argmax(np.linalg.norm(level, axis=1).mean(axis=0)))]
    angle = np.arctan2(np.cross(direction, axis) @ up, (direction * axis).sum(axis=1))
    known = np.isfinite(angle)
    if not known.any():
        return np.asarray(known)
    off = np.angle(np.exp(1j * (angle[:, None] - angle[known])))
    usual = angle[known][int(np.argmax((np.abs(off[known]) < _MAX_HEADING_CHANGE_RAD).sum(axis=0)))]
    near = np.abs(np.angle(np.exp(1j * (np.nan_to_num(angle) - usual)))) < _MAX_HEADING_CHANGE_RAD
    return np.asarray(known & near)


def vertical_from_path(path_m: FloatArray, body_up: FloatArray) -> FloatArray | None:
    """Estimate the vertical from a trunk's path. A walk is horizontal, except for the bounce of the steps.

    Args:
        path_m: (N,3) positions of the trunk, metres.
        body_up: (3,) approximate vertical from the body.

    Returns:
        The up direction (3,); None if the path is too narrow, not horizontal enough, or too far from the
        body's vertical.
    """
    weight = np.ones(len(path_m))
    normal = np.asarray(body_up, dtype=np.float64)
    for _ in range(_FIT_ITERATIONS):
        centred = path_m - np.average(path_m, axis=0, weights=weight)
        normal = np.linalg.svd(centred * np.sqrt(weight)[:, None], full_matrices=False)[2][2]
        weight = 1.0 / (1.0 + (centred @ normal / _BOUNCE_M) ** 2)
    level = np.abs(centred @ normal) < 2.0 * _BOUNCE_M
    if level.mean() < _MIN_LEVEL_SHARE or level.sum() < _MIN_LEVEL_POINTS:
        return None
    inside = path_m[level] - path_m[level].mean(axis=0)
    sigmas = np.linalg.svd(inside, compute_uv=False) / np.sqrt(level.sum())
    normal = normal if normal @ body_up > 0.0 else -normal
    if sigmas[1] < _MIN_PATH_WIDTH_M or normal @ body_up < np.cos(_MAX_BODY_ANGLE_RAD):
        return None
    return np.asarray(normal)


def path_slopes(path_m: FloatArray, up: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit the slope of a trunk's path. The trunk may be lower for some of the time, because the person bends.

    Args:
        path_m: (N,3) positions of the trunk, metres.
        up: (3,) vertical.

    Returns:
        Slopes (2,) along the two principal horizontal axes of the path, variances (2,) of the slopes by the
        bounce of the steps, and these axes (2,3).
    """
    centred = path_m - path_m.mean(axis=0)
    across = centred - np.outer(centred @ up, up)
    # The vertical is the eigenvector with the smallest eigenvalue, -1.
    spread, vectors = np.linalg.eigh(across.T @ across / len(across) - np.outer(up, up))
    axes = vectors[:, 1:].T
    design = np.column_stack([across @ axes.T, np.ones(len(across))])
    height = centred @ up
    weight = np.ones(len(across))
    for _ in range(_FIT_ITERATIONS):
        weighted = design.T * weight
        slopes = np.linalg.solve(weighted @ design + 1e-9 * np.eye(3), weighted @ height)
        off = height - design @ slopes
        weight = 1.0 / (1.0 + (off / _BOUNCE_M) ** 2)
    steps = max(1.0, float(np.linalg.norm(np.diff(across, axis=0), axis=1).sum()) / _STEP_M)
    variance = float(weight @ off**2 / weight.sum()) / steps
    return slopes[:2], variance / np.maximum(spread[1:], 1e-9), axes
