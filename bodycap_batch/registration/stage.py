"""Stage 3: estimate the pose of every frame by tracking map points from the keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration
from bodycap_batch.registration.poses.keyframe_requests import request_keyframes
from bodycap_batch.registration.poses.map_error import with_map_error
from bodycap_batch.registration.poses.misplaced_keyframes import (
    find_misplaced_keyframes,
    map_without_keyframes,
)
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, FramePose
from bodycap_batch.registration.poses.trajectory import (
    acceptance_criteria,
    build_trajectory,
    solve_camera,
)
from bodycap_batch.registration.poses.turning_tracks import rotation_of_camera, turn_tracks
from bodycap_batch.registration.recovery.path_smoothing import smooth_if_final
from bodycap_batch.registration.tracking.frame_ranges import TrackCache, track_all
from bodycap_batch.registration.tracking.klt import MeasuredTurns, Tracks, select_keyframe_points


def register_frames(
    camera: CaptureCamera,
    maps: Sequence[Map],
    selection: KeyframeSelection,
    options: RegistrationOptions,
    context: StageContext,
    previous: Registration | None = None,
) -> Registration:
    """Estimate the pose of every frame of one camera against the map.

    Map points are tracked from each keyframe forward to the next keyframe and backward to the previous
    keyframe. A point may therefore have two tracks in a frame, from two keyframes. Both tracks are used,
    because their errors are independent. No map points are added.

    Args:
        camera: The camera.
        maps: Maps of the room. The map with the most keyframes of this camera is used.
        selection: The keyframes of the camera, the sharpness of its frames and the noise of its tracks.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        context: Threads, progress and cancellation.
        previous: An earlier registration against a smaller map. Its observations between unchanged
            neighbouring keyframes are used again. Every pose is estimated again.

    Returns:
        The registration: for every frame a pose or the reason why the frame is lost, and the frames that
        should become keyframes.
    """
    offered = _offered_keyframes(selection, previous)
    scene_map = _map_of_camera(maps, camera.name)
    if scene_map is None:
        return _registration_without_map(camera, selection, offered)
    criteria = acceptance_criteria(camera, selection, options)
    points_by_keyframe = select_keyframe_points(scene_map, camera.name)
    solved = None if previous is None else previous.trajectory
    rotation = rotation_of_camera(camera, scene_map, selection, solved)
    turns = measured_turns(scene_map.cameras[camera.name], rotation)
    cache = TrackCache.from_registration(previous)
    tracks = track_all(camera, points_by_keyframe, cache, context, turns)
    context.progress(0, 0, "misplaced keyframes")
    scene_map, tracks, misplaced = _track_without_misplaced(
        camera, scene_map, tracks, criteria, context, rotation
    )
    if selection.frozen.any():
        tracks = tracks.select(~selection.frozen[tracks.frame])
    context.progress(0, 0, "poses")
    poses = solve_camera(camera, scene_map, tracks, criteria, context.threads, rotation)
    trajectory = smooth_if_final(build_trajectory(camera, scene_map.gauge, poses, selection))
    trajectory = with_map_error(trajectory, maps)
    already_requested = np.zeros(0, np.int64) if previous is None else previous.wanted_keyframes
    requested = request_keyframes(trajectory.localised | selection.frozen, selection.sharpness, offered)
    requested = np.setdiff1d(requested[~selection.frozen[requested]], selection.damaged)
    return Registration(
        trajectory=trajectory,
        obs_frame=tracks.frame,
        obs_keyframe=tracks.keyframe,
        obs_feature=tracks.feature,
        obs_px=tracks.px,
        wanted_keyframes=np.union1d(requested, np.setdiff1d(misplaced, already_requested)),
        tried_keyframes=offered,
    )


def _track_without_misplaced(
    camera: CaptureCamera,
    scene_map: Map,
    tracks: Tracks,
    criteria: AcceptanceCriteria,
    context: StageContext,
    rotation: RotationPath | None,
) -> tuple[Map, Tracks, IntArray]:
    """Remove misregistered keyframes, and track the frames around them from the remaining keyframes.

    If the rotation of a camera with a rolling shutter is known, the tracks are compared with the map at the
    instants of the middle rows.

    Returns:
        The map without the misregistered keyframes, the tracks, and the frame indices of the removed
        keyframes.
    """
    nothing = np.zeros(0, np.int64)
    turned = turn_tracks(camera.name, scene_map, tracks, rotation)
    misplaced = find_misplaced_keyframes(camera.name, scene_map, turned, criteria)
    if len(misplaced) == 0:
        return scene_map, tracks, nothing
    cache = TrackCache(tracks, sorted(select_keyframe_points(scene_map, camera.name)))
    remaining = map_without_keyframes(scene_map, misplaced)
    turns = measured_turns(scene_map.cameras[camera.name], rotation)
    tracks = track_all(camera, select_keyframe_points(remaining, camera.name), cache, context, turns)
    return remaining, tracks, scene_map.keyframe_frame[misplaced]


def measured_turns(lens: Camera, rotation: RotationPath | None) -> MeasuredTurns | None:
    """Return the rotations between frames that a gyroscope measured; None if there are none."""
    if rotation is None or rotation.gyro is None:
        return None
    step, _ = rotation.steps()
    measured = rotation.measured()
    return MeasuredTurns(lens=lens, step=step, known=measured[1:] & measured[:-1])


def _offered_keyframes(selection: KeyframeSelection, previous: Registration | None) -> IntArray:
    """Return the indices of the frames that were offered to the mapper so far."""
    if previous is None:
        return np.asarray(selection.frames)
    return np.union1d(previous.tried_keyframes, previous.wanted_keyframes)


def _map_of_camera(maps: Sequence[Map], camera: str) -> Map | None:
    """Return the map with the most keyframes of a camera; None if no map has a keyframe of the camera."""
    counts = [len(item.keyframes_of(camera)) for item in maps]
    return maps[int(np.argmax(counts))] if counts and max(counts) > 0 else None


def _registration_without_map(
    camera: CaptureCamera, selection: KeyframeSelection, offered: IntArray
) -> Registration:
    """Return a registration in which every frame has the status NO_MAP."""
    no_tracks = Tracks.join_and_clear([])
    poses = [FramePose(status=FrameStatus.NO_MAP)] * len(camera.times_ns)
    return Registration(
        trajectory=build_trajectory(camera, "none", poses, selection),
        obs_frame=no_tracks.frame,
        obs_keyframe=no_tracks.keyframe,
        obs_feature=no_tracks.feature,
        obs_px=no_tracks.px,
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=offered,
    )
