"""Stage 3: estimate the pose of every frame by tracking map points from the keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration
from bodycap_batch.registration.poses.keyframe_requests import request_keyframes
from bodycap_batch.registration.poses.map_error import with_map_error, without_map_error
from bodycap_batch.registration.poses.misplaced_keyframes import (
    find_misplaced_keyframes,
    map_without_keyframes,
)
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria, FramePose
from bodycap_batch.registration.poses.rig_members import (
    RegisteredCamera,
    estimate_relative_poses,
    initial_rig_poses,
    rig_members,
)
from bodycap_batch.registration.poses.trajectory import (
    acceptance_criteria,
    build_trajectory,
    solve_camera,
    solve_rig,
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


def register_in_rig(
    own: RegisteredCamera,
    others: Sequence[RegisteredCamera],
    maps: Sequence[Map],
    selection: KeyframeSelection,
    options: RegistrationOptions,
    threads: int = 1,
) -> tuple[Registration, list[RelativePose]]:
    """Estimate the pose of every frame of one camera with the observations of all cameras of its rig.

    The relative pose of two cameras is the robust mean over all instants at which both cameras have a pose.
    A camera is excluded if the number of these instants is too small, or if the relative pose scatters too
    much between these instants.

    Args:
        own: The camera with its registration.
        others: The other cameras on the same body segment, exposed at the same instants.
        maps: The maps that the camera was registered against.
        selection: The keyframes of the camera.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        threads: Number of threads that solve frames. The result does not depend on it.

    Returns:
        The registration with poses from all cameras of the rig, and the relative pose of each other camera.

    Source: generalised cameras, Pless, "Using many cameras as one", CVPR 2003.
    """
    own_alone, *others_alone = (_without_map_error(each, maps) for each in (own, *others))
    relative_poses = estimate_relative_poses(own_alone, others_alone)
    members = rig_members(own, others, relative_poses)
    gauge = own.registration.trajectory.gauge
    scene_map = next((scene for scene in maps if scene.gauge == gauge), None)
    if scene_map is None or len(members) == 1:
        return own.registration, relative_poses
    criteria = acceptance_criteria(own.camera, selection, options)
    for member in members:
        turned = turn_tracks(member.camera.name, scene_map, member.tracks, member.rotation)
        misplaced = find_misplaced_keyframes(member.camera.name, scene_map, turned, criteria)
        scene_map = map_without_keyframes(scene_map, misplaced)
    start = initial_rig_poses(own, others, members)
    poses = solve_rig(members, scene_map, start, criteria, threads)
    trajectory = smooth_if_final(build_trajectory(own.camera, scene_map.gauge, poses, selection))
    return replace(own.registration, trajectory=with_map_error(trajectory, maps)), relative_poses


def _without_map_error(camera: RegisteredCamera, maps: Sequence[Map]) -> RegisteredCamera:
    """Return a camera whose poses have the covariances that follow from an exact map."""
    path = without_map_error(camera.registration.trajectory, maps)
    return replace(camera, registration=replace(camera.registration, trajectory=path))


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
