"""What standing and walking tell before anything is solved: the vertical, the way ahead, a T-pose.

Rules about a whole capture (a walker's chest is upright, faces where it goes) are wrong by the same amount in
every frame. Each counts once, however many frames it is applied to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone, anatomical_axes
from bodycap_batch.merging.cameras.track import CameraTrack, pick_evenly
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.skeleton import SkeletonModel

MIN_WALKING_SPEED_M_PER_S = 0.5
_STEP_NS = 500_000_000
"""The velocity is taken over half a second, about a step: the trunk sways within one."""
UPRIGHT_SIGMA_RAD = float(np.radians(5.0))
HEADING_SIGMA_RAD = float(np.radians(8.0))
"""How far a walker's mean chest is off the vertical and off the way it goes: the lean and turn of a habit,
and a rig's or preset's own idea of the chest's axes."""
STANDING_SIGMA_RAD = float(np.radians(7.0))
"""The same for a chest that is at its highest in a capture without walking: who bends and lifts stands up in
between. A walker's 5 degrees, and about as many for the bend that the height leaves open."""
_HIGHEST_PERCENTILE, _LOW_PERCENTILE = 95.0, 25.0
_STANDING_DROP_M = 0.02
"""How far below its highest a chest still counts as up: half a metre over hips, it bends by 16 degrees."""
_MIN_WALKING_SHARE = 0.125
"""Share of the ticks below which walking is a step aside between other things, mostly bowed."""
_BENT_DROP_M = 0.12
"""A chest this far below where it mostly is in walking is bowed, or knees are bent: walkers' move by 5 cm."""
_MAX_HEADING_CHANGE_RAD = float(np.radians(35.0))
_BOUNCE_M = 0.03
"""Half of the rise and fall of a walking trunk, 4 to 5 cm from lowest to highest."""
_MIN_LEVEL_SHARE = 0.6
_MIN_PATH_WIDTH_M = 0.3
"""Standard deviation of the path across: at 0.3 m, steps whose bounce is 2 cm tilt the plane of ten of them
by a degree."""
_MAX_BODY_ANGLE_RAD = float(np.radians(30.0))
_MAX_SAMPLES = 300
GESTURE_DURATION_S = 4.0
"""A posture tells little of the one within two seconds before or after it: gestures last about as long."""
_TRUNK = ("Spine1", "Spine", "Hips")


@dataclass(frozen=True, slots=True, kw_only=True)
class Posture:
    """What is known of the body at the sampled ticks (K,).

    Attributes:
        up: (3,) the vertical in the map, None where nothing but the body tells it.
        walking: (K,) where the body walks ahead.
        ahead: (K,3) horizontal direction it walks, NaN elsewhere.
        t_pose: (K,) where it stands in a T-pose.
        standing: (K,) where a body that walks nowhere is as upright as it gets.
    """

    up: FloatArray | None
    walking: BoolArray
    walking_direction: FloatArray
    t_pose: BoolArray
    standing: BoolArray

    @staticmethod
    def unknown(count: int) -> Posture:
        """No knowledge of `count` ticks."""
        none = np.zeros(count, dtype=bool)
        return Posture(
            up=None, walking=none, walking_direction=np.full((count, 3), np.nan), t_pose=none, standing=none
        )


def find_posture(
    track: CameraTrack, times_ns: IntArray, up: FloatArray | None, t_pose_ns: tuple[int, int] | None
) -> Posture:
    """Tell where the trunk's camera walks ahead.

    Args:
        track: The trunk's camera, metres (a provisional scale will do).
        times_ns: (K,) the sampled times.
        up: (3,) the vertical in the map, or None.
        t_pose_ns: From when to when a T-pose stands.
    """
    posture = Posture.unknown(len(times_ns))
    if t_pose_ns is not None:
        posture = replace(posture, t_pose=(times_ns >= t_pose_ns[0]) & (times_ns <= t_pose_ns[1]))
    if up is None:
        return posture
    before, after = (track.poses_at(times_ns + sign * _STEP_NS // 2, max_gap_ns=_STEP_NS) for sign in (-1, 1))
    velocity = (after[0] - before[0])[:, :3, 3] / (1e-9 * _STEP_NS)
    velocity -= np.outer(velocity @ up, up)
    speed = np.linalg.norm(velocity, axis=1)
    moving = before[1] & after[1] & (speed > MIN_WALKING_SPEED_M_PER_S)
    ahead = np.where(moving[:, None], velocity / np.maximum(speed, 1e-9)[:, None], np.nan)
    poses, _ = track.poses_at(times_ns, max_gap_ns=_STEP_NS)
    height_m = poses[:, :3, 3] @ up
    moving &= height_m > np.percentile(height_m[moving], 75.0) - _BENT_DROP_M if moving.any() else False
    walking = moving & _faces_walking_direction(poses[:, :3, :3], ahead, up)
    if walking.sum() < max(5, 0.5 * moving.sum()):
        # Half of the steps go sideways or backwards: which way this body faces is not told by where it goes.
        walking, ahead = moving, np.full_like(ahead, np.nan)
    if walking.mean() < _MIN_WALKING_SHARE:
        walking = np.zeros_like(walking)
    standing = np.zeros_like(walking) if walking.any() else _standing_ticks(track, height_m, up)
    return replace(
        posture,
        up=up,
        walking=walking,
        walking_direction=np.where(walking[:, None], ahead, np.nan),
        standing=standing & ~posture.t_pose,
    )


def is_mostly_walking(track: CameraTrack) -> bool:
    """Whether a trunk's camera (metres) goes as fast as a walk for more than half of the time."""
    times_ns = track.times_ns[pick_evenly(np.arange(len(track.times_ns)), _MAX_SAMPLES)]
    before, after = (track.poses_at(times_ns + sign * _STEP_NS // 2, max_gap_ns=_STEP_NS) for sign in (-1, 1))
    speed = np.linalg.norm((after[0] - before[0])[:, :3, 3], axis=1) / (1e-9 * _STEP_NS)
    return bool((before[1] & after[1] & (speed > MIN_WALKING_SPEED_M_PER_S)).mean() > 0.5)


def _standing_ticks(track: CameraTrack, height_m: FloatArray, up: FloatArray) -> BoolArray:
    """Where heights (K,) are about the greatest of the trunk's path, nowhere if it hardly rises and falls.

    Who sits, or leans on a desk or a cart, is never upright, however high.
    """
    often, highest = np.percentile(track.map_from_cam[:, :3, 3] @ up, [_LOW_PERCENTILE, _HIGHEST_PERCENTILE])
    return np.asarray((height_m > highest - _STANDING_DROP_M) & (highest - often > _BENT_DROP_M))


def _faces_walking_direction(rotation: FloatArray, ahead: FloatArray, up: FloatArray) -> BoolArray:
    """Where the camera's heading (T,) is at its usual angle to the way it goes."""
    level = rotation - up[:, None] * np.einsum("i,tij->tj", up, rotation)[:, None, :]
    axis = level[:, :, int(np.argmax(np.linalg.norm(level, axis=1).mean(axis=0)))]
    angle = np.arctan2(np.cross(ahead, axis) @ up, (ahead * axis).sum(axis=1))
    known = np.isfinite(angle)
    if not known.any():
        return np.asarray(known)
    off = np.angle(np.exp(1j * (angle[:, None] - angle[known])))
    usual = angle[known][int(np.argmax((np.abs(off[known]) < _MAX_HEADING_CHANGE_RAD).sum(axis=0)))]
    near = np.abs(np.angle(np.exp(1j * (np.nan_to_num(angle) - usual)))) < _MAX_HEADING_CHANGE_RAD
    return np.asarray(known & near)


_OWN_UP, _OWN_LEFT = gtsam.Unit3(np.array([0.0, 0.0, 1.0])), gtsam.Unit3(np.array([1.0, 0.0, 0.0]))


class AttitudeFactors:
    """Adds what is known of the posture at a tick.

    Args:
        bones: The graph's bones.
        posture: The knowledge.
    """

    def __init__(self, bones: Sequence[Bone], posture: Posture) -> None:
        self._posture = posture
        self._trunk = [position for position, bone in enumerate(bones) if bone.role in _TRUNK]
        upright = posture.walking | posture.t_pose
        self._upright = _noise_for_one_observation(UPRIGHT_SIGMA_RAD, int(upright.sum()))
        self._standing = _noise_for_one_observation(STANDING_SIGMA_RAD, int(posture.standing.sum()))
        self._facing = _noise_for_one_observation(
            HEADING_SIGMA_RAD, int(np.isfinite(posture.walking_direction[:, 0]).sum())
        )

    def add(self, graph: Any, tick: int) -> None:
        """Add the factors of one tick: the trunk's up, and its left across the way it goes."""
        posture = self._posture
        straight = posture.walking[tick] or posture.t_pose[tick]
        if posture.up is None or not (straight or posture.standing[tick]):
            return
        noise = self._upright if straight else self._standing
        for bone in self._trunk:
            key = bone_key(tick, bone)
            graph.add(gtsam.AttitudeFactorPose3(key, gtsam.Unit3(posture.up), noise, _OWN_UP))
            if np.isfinite(posture.walking_direction[tick, 0]):
                left = gtsam.Unit3(np.cross(posture.up, posture.walking_direction[tick]))
                graph.add(gtsam.AttitudeFactorPose3(key, left, self._facing, _OWN_LEFT))


def _noise_for_one_observation(sigma: float, count: int) -> Any:
    """Noise of a rule that is applied `count` times and counts once."""
    return gtsam.noiseModel.Isotropic.Sigma(2, sigma * float(np.sqrt(max(count, 1))))


def widen_joint_priors(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray, times_ns: IntArray
) -> tuple[Bone, ...]:
    """Bones whose everyday range is wider by what a capture happens to show.

    A joint's mean over a capture differs from its ease by the person's habit, a share of its everyday range,
    and by the gestures that fall into the capture: their spread over the root of how many there were. Where
    it comes out further off than that although the prior drew it in (arms that lift all the time), its range
    is that wide: one draw of a normal distribution is likeliest where sigma is the draw.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        world_from_bone: (K,B,4,4) poses solved at sampled ticks, none of them in a T-pose.
        times_ns: (K,) the ticks, increasing.
    """
    few = 1.0 / _gesture_count(times_ns)
    out = []
    for index, bone in enumerate(bones):
        if bone.parent < 0:
            out.append(bone)
            continue
        turn = np.swapaxes(world_from_bone[:, bone.parent, :3, :3], 1, 2) @ world_from_bone[:, index, :3, :3]
        axes = anatomical_axes(skeleton, bone.role)
        off = so3_log(bone.mean_rotation.T @ turn) @ axes
        usual = np.diagonal(axes.T @ bone.rotation_covariance @ axes)
        drawn = usual + off.var(axis=0) * few / POSTURE_BIAS_SHARE**2
        spread = np.diag(np.maximum(drawn, (off.mean(axis=0) / POSTURE_BIAS_SHARE) ** 2))
        out.append(replace(bone, rotation_covariance=axes @ spread @ axes.T))
    return tuple(out)


def _gesture_count(times_ns: IntArray) -> float:
    """How many gestures ticks (K,) can have seen: those of the time they span, less where no tick fell."""
    apart_ns = round(1e9 * GESTURE_DURATION_S)
    since_ns = times_ns - times_ns[0]
    return max(1.0, min(float(since_ns[-1]) / apart_ns, float(len(np.unique(since_ns // apart_ns)))))


def samples_per_gesture(times_ns: IntArray) -> float:
    """How many of the ticks (K,) fall into one gesture, 1 or more."""
    return max(1.0, len(times_ns) / _gesture_count(times_ns))


def vertical_from_path(path_m: FloatArray, body: FloatArray) -> FloatArray | None:
    """The vertical from a trunk's path (N,3): walking is level, but for the bounce of the steps.

    Returns:
        Up (3,), or None where the path is too narrow, too uneven, or far from the body's own up.
    """
    weight = np.ones(len(path_m))
    normal = np.asarray(body, dtype=np.float64)
    for _ in range(15):
        centred = path_m - np.average(path_m, axis=0, weights=weight)
        normal = np.linalg.svd(centred * np.sqrt(weight)[:, None], full_matrices=False)[2][2]
        weight = 1.0 / (1.0 + (centred @ normal / _BOUNCE_M) ** 2)
    level = np.abs(centred @ normal) < 2.0 * _BOUNCE_M
    if level.mean() < _MIN_LEVEL_SHARE or level.sum() < 30:
        return None
    inside = path_m[level] - path_m[level].mean(axis=0)
    spread = np.linalg.svd(inside, compute_uv=False) / np.sqrt(level.sum())
    normal = normal if normal @ body > 0.0 else -normal
    if spread[1] < _MIN_PATH_WIDTH_M or normal @ body < np.cos(_MAX_BODY_ANGLE_RAD):
        return None
    return np.asarray(normal)
