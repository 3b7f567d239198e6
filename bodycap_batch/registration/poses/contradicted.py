"""Find poses that the keyframes around them, or the rotation of the video, contradict, and withdraw them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.model.rotation_chain import RotationChain, find_folded
from bodycap_batch.model.scene import FrameStatus, Map, Registration, Trajectory

_MIN_MISPLACED = 2
"""Minimum number of misplaced keyframes between two keyframes of the map, so that the frames between these
two are withdrawn. A single misplaced keyframe is often a blurred one. Evidence: none."""


def withdraw_contradicted_poses(
    registration: Registration, maps: Sequence[Map], misplaced: Collection[int]
) -> Registration:
    """Withdraw the poses of the frames that lie in a block of misplaced keyframes.

    Mapping removed these keyframes because their matches contradict the rest of the map. The frames around
    them see the same points from almost the same place. Their poses can be wrong by decimetres, although many
    points agree with them.

    Args:
        registration: The registration of one camera.
        maps: The maps that the camera was registered against.
        misplaced: Frame indices of the camera's keyframes that contradict the map.

    Returns:
        The registration. The frames without a pose have the status `CONTRADICTED`.
    """
    path = registration.trajectory
    inside = contradicted_frames(path, maps, misplaced) & path.localised
    if not inside.any():
        return registration
    record_act(Mechanism.CONTRADICTED_POSES, int(inside.sum()))
    return replace(registration, trajectory=path.without(inside, FrameStatus.CONTRADICTED))


def contradicted_frames(path: Trajectory, maps: Sequence[Map], misplaced: Collection[int]) -> BoolArray:
    """Return for each frame (N,) of a camera whether it lies in a block of misplaced keyframes.

    Args:
        path: The trajectory of the camera.
        maps: The maps that the camera was registered against.
        misplaced: Frame indices of the camera's keyframes that contradict the map.
    """
    scene = next((scene for scene in maps if scene.gauge == path.gauge), None)
    if scene is None or not misplaced or not is_on(Mechanism.CONTRADICTED_POSES):
        return np.zeros(len(path.status), dtype=bool)
    kept = scene.keyframe_frame[scene.keyframes_of(path.camera)]
    return _frames_in_blocks(len(path.status), np.asarray(kept), np.array(sorted(misplaced)))


def _frames_in_blocks(count: int, kept: IntArray, misplaced: IntArray) -> BoolArray:
    """Return for each of `count` frames whether it lies in a block of misplaced keyframes.

    A block lies between two successive keyframes of the map, or before the first or after the last one. The
    keyframes of the map are not part of it.
    """
    inside = np.zeros(count, dtype=bool)
    bounds = [-1, *np.setdiff1d(kept, misplaced).tolist(), count]
    for before, after in pairwise(bounds):
        if ((misplaced > before) & (misplaced < after)).sum() >= _MIN_MISPLACED:
            inside[before + 1 : after] = True
    return inside


def find_folded_poses(chain: RotationChain | None, gauge_from_cam: FloatArray) -> BoolArray:
    """Return for each frame (N,) whether the rotation of the video contradicts its pose.

    Args:
        chain: How the camera turns, by the tracks of its video; None if it is unknown.
        gauge_from_cam: (N,4,4) poses; NaN for frames without a pose.
    """
    out = np.zeros(len(gauge_from_cam), dtype=bool)
    if is_on(Mechanism.CONTINUITY):
        posed = np.flatnonzero(np.isfinite(gauge_from_cam[:, 0, 0]))
        out[posed] = find_folded(chain, posed, gauge_from_cam[posed, :3, :3])
        record_act(Mechanism.CONTINUITY, int(out.sum()))
    return out
