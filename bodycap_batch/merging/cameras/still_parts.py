"""Find the parts of a path in which a camera on a limb stands still in the room while the trunk moves on.

Such a camera fell off or was put down. Its poses are right, but they say nothing about the body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import BoolArray, runs
from bodycap_batch.merging.cameras.stationary import PERCENTILE_SIGMAS, WINDOW_FRAMES, with_noise
from bodycap_batch.merging.cameras.track import MAX_COARSE_GAP_NS, CameraTrack
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_MIN_WINDOWS = 2
"""Minimum number of successive windows of a still part. Evidence: none."""
_MAX_SHIFT_M, _MAX_TURN_RAD = 0.002, float(np.radians(0.2))
"""Maximum change between the means of two successive windows of a camera that stands still, without noise:
metres, radians. Derivation: a hand that rests on a table moves by more while the trunk walks."""
_MIN_TRUNK_MOVEMENT_M = 0.3
"""Minimum movement (metres) of the trunk's camera during a still part: the 90th percentile of the distance
from its median position. Derivation: a hand can hold on to something fixed while the trunk sways by less."""
_ON_THE_FLOOR = frozenset({"Foot", "ToeBase"})
"""Parts of limbs that stand still in each step."""


def still_parts(
    tracks: Sequence[CameraTrack], mounts: Mapping[str, Mount], scale: float
) -> dict[str, BoolArray]:
    """Find the frames of cameras on limbs that stand still while the trunk moves.

    Args:
        tracks: Tracks in one map, the track of the trunk's camera first.
        mounts: Mount of each camera, by camera name.
        scale: Metres per map unit; a provisional value is accurate enough.

    Returns:
        By camera with a still part, (N,) True for frames in a still part. The result is empty if the first
        camera is on a limb.
    """
    if split_side(mounts[tracks[0].camera].role)[0]:
        return {}
    out = {}
    for track in tracks[1:]:
        side, part = split_side(mounts[track.camera].role)
        if side and part not in _ON_THE_FLOOR:
            still = _still_frames(track, tracks[0], scale)
            if still.any():
                out[track.camera] = still
    return out


def _still_frames(track: CameraTrack, trunk: CameraTrack, scale: float) -> BoolArray:
    """Return (N,) True for the frames of a track in which it stands still while the trunk moves."""
    out = np.zeros(len(track.times_ns), dtype=np.bool_)
    count = len(out) // WINDOW_FRAMES
    if count < _MIN_WINDOWS:
        return out
    used = count * WINDOW_FRAMES
    centres_m = scale * track.map_from_cam[:used, :3, 3].reshape(count, WINDOW_FRAMES, 3)
    turns = Rotation.from_matrix(track.map_from_cam[:used, :3, :3]).as_quat().reshape(count, -1, 4)
    means = Rotation.concatenate([Rotation.from_quat(each).mean() for each in turns])
    shift_m = np.linalg.norm(np.diff(centres_m.mean(axis=1), axis=0), axis=1)
    turn_rad = (means[:-1].inv() * means[1:]).magnitude()
    # The noise of the difference of two means follows from the noise of one frame.
    noise_m, noise_rad = (
        PERCENTILE_SIGMAS * sigma * float(np.sqrt(2.0 / WINDOW_FRAMES))
        for sigma in (scale * float(np.median(track.sigma_map)), float(np.median(track.sigma_rad)))
    )
    is_near = shift_m < with_noise(_MAX_SHIFT_M, noise_m)
    is_near &= turn_rad < with_noise(_MAX_TURN_RAD, noise_rad)
    for start, stop in runs(is_near):
        first, last = start * WINDOW_FRAMES, (stop + 1) * WINDOW_FRAMES
        # The part ends with the track if the rest is shorter than a window.
        last = len(out) if last == used else last
        if stop + 1 - start >= _MIN_WINDOWS and _moves(trunk, track, first, last, scale):
            out[first:last] = True
    return out


def _moves(trunk: CameraTrack, track: CameraTrack, first: int, last: int, scale: float) -> bool:
    """Return True if the trunk's camera moves during the frames `first` to `last` (excluded) of a track."""
    poses, valid = trunk.poses_at(track.times_ns[first:last], max_gap_ns=MAX_COARSE_GAP_NS)
    centres_m = scale * poses[valid, :3, 3]
    if len(centres_m) < WINDOW_FRAMES:
        return False
    away_m = np.linalg.norm(centres_m - np.median(centres_m, axis=0), axis=1)
    return float(np.percentile(away_m, 90.0)) >= _MIN_TRUNK_MOVEMENT_M
