"""Stage 3: every frame's pose, by tracking the map's points into it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.config.lost_frames import LEAST_LOST
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration.poses.keyframe_requests import request_keyframes
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
from bodycap_batch.registration.poses.trajectory import pose_array, solve_camera, solve_rig
from bodycap_batch.registration.recovery.path_smoothing import smooth_weak_centres
from bodycap_batch.registration.recovery.point_refinement import refine_points, remove_weak_boundary_poses
from bodycap_batch.registration.recovery.recover import can_recover
from bodycap_batch.registration.tracking.frame_ranges import TrackCache, track_all
from bodycap_batch.registration.tracking.klt import Tracks, camera_pixel_scale, select_keyframe_points

_MAP_NOISE_PX = 0.6
_INLIER_SIGMAS = 3.5
_BLUR_RATIO = 0.6
_BLUR_WINDOW_FRAMES = 15


def register_frames(
    camera: CaptureCamera,
    maps: Sequence[Map],
    selection: KeyframeSelection,
    options: RegistrationOptions,
    context: StageContext,
    previous: Registration | None = None,
) -> Registration:
    """Solve the pose of every frame of one camera against the map.

    The map's points are tracked from both neighbouring keyframes, into them too, and every observation
    counts: two tracks of one point start from two keyframes' independent errors. No new points are made.

    Args:
        camera: The camera's video.
        maps: Models of the room; the one with most of this camera's keyframes is used.
        selection: The camera's keyframes (sharpness and track noise are read from it).
        options: Limits.
        context: Progress, cancellation.
        previous: An earlier registration against a smaller map. Stretches whose keyframes did not
            change keep their observations; every pose is solved again.

    Returns:
        A pose or a reason for every frame, and the frames that should become keyframes.
    """
    offered = _offered_keyframes(selection, previous)
    scene_map = _map_of_camera(maps, camera.name)
    if scene_map is None:
        return _registration_without_map(camera, offered)
    criteria = acceptance_criteria(camera, selection, options)
    tracks = track_all(
        camera, select_keyframe_points(scene_map, camera.name), TrackCache.from_registration(previous), context
    )
    scene_map, tracks, misplaced = _track_without_misplaced(camera, scene_map, tracks, criteria, context)
    poses = solve_camera(camera, scene_map, tracks, criteria)
    trajectory = _smooth_if_final(build_trajectory(camera, scene_map.gauge, poses, selection.sharpness))
    already_requested = np.zeros(0, np.int64) if previous is None else previous.wanted_keyframes
    requested = request_keyframes(trajectory.localised, selection.sharpness, offered)
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
) -> tuple[Registration, list[RelativePose]]:
    """Solve every frame of one camera again, with what the others of its rig see at the same instant.

    Where they sit beside it is the robust mean over all frames in which both were localised alone. Others of
    which that says too little, or whose place scatters, are left out.

    Args:
        own: The camera with its registration.
        others: The others on its segment, exposed at the same instants.
        maps: The models it was registered against.
        selection: Its keyframes.
        options: Limits.

    Returns:
        The registration with poses that all cameras support, and where each other one sits.

    Source: generalised cameras, Pless, "Using many cameras as one", CVPR 2003.
    """
    relative_poses = estimate_relative_poses(own, others)
    members = rig_members(own, others, relative_poses)
    scene_map = next((scene for scene in maps if scene.gauge == own.registration.trajectory.gauge), None)
    if scene_map is None or len(members) == 1:
        return own.registration, relative_poses
    criteria = acceptance_criteria(own.camera, selection, options)
    for member in members:
        misplaced = find_misplaced_keyframes(member.camera.name, scene_map, member.tracks, criteria)
        scene_map = map_without_keyframes(scene_map, misplaced)
    poses = solve_rig(members, scene_map, initial_rig_poses(own, others, members), criteria)
    trajectory = _smooth_if_final(build_trajectory(own.camera, scene_map.gauge, poses, selection.sharpness))
    return replace(own.registration, trajectory=trajectory), relative_poses


def remove_misplaced_keyframes(
    scene_map: Map,
    cameras: Iterable[RegisteredCamera],
    selection: KeyframeSelection,
    options: RegistrationOptions,
) -> Map:
    """The map without keyframes that the video of one of its cameras contradicts.

    Args:
        scene_map: The map.
        cameras: With their registrations; those against another map are passed over.
        selection: Keyframes of one of them; the noise of tracks is read from it.
        options: Limits.
    """
    misplaced: list[IntArray] = []
    for camera in cameras:
        if camera.registration.trajectory.gauge == scene_map.gauge:
            criteria = acceptance_criteria(camera.camera, selection, options)
            misplaced.append(find_misplaced_keyframes(camera.camera.name, scene_map, camera.tracks, criteria))
    return map_without_keyframes(scene_map, np.concatenate([np.zeros(0, np.int64), *misplaced]))


def prepare_recovery(
    own: RegisteredCamera,
    others: Sequence[Trajectory],
    scene_map: Map,
    selection: KeyframeSelection,
    options: RegistrationOptions,
) -> tuple[Map, Registration]:
    """What a camera's lost frames are to be looked for with.

    Poses at the ends of lost stretches that little speaks for are taken out, of all cameras; the map's points
    are moved to where the other frames see them, and the camera's frames are solved against these.

    Args:
        own: The camera with its registration, which is its own and no rig's.
        others: The other cameras' paths.
        scene_map: The map.
        selection: Its keyframes.
        options: Limits.

    Returns:
        The map, in the same gauge, and the registration; both as they were where no pose is taken out (moved
        points are no better then: walk12 with covered lenses 0.34, 0.35 cm), or too few are left to look for
        others.
    """
    before = [own.registration.trajectory, *(path for path in others if path.gauge == scene_map.gauge)]
    paths = [remove_weak_boundary_poses(path, options.min_inliers) for path in before]
    none_removed = all(path is unchanged for path, unchanged in zip(paths, before, strict=True))
    if none_removed or not can_recover(paths[0]):
        return scene_map, own.registration
    refined_map = refine_points(scene_map, paths)
    criteria = acceptance_criteria(own.camera, selection, options)
    poses = solve_camera(own.camera, refined_map, own.tracks, criteria)
    path = build_trajectory(own.camera, scene_map.gauge, poses, selection.sharpness)
    path = remove_weak_boundary_poses(path, options.min_inliers)
    if not can_recover(path):
        return scene_map, own.registration
    return refined_map, replace(own.registration, trajectory=path)


def _track_without_misplaced(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, criteria: AcceptanceCriteria, context: StageContext
) -> tuple[Map, Tracks, IntArray]:
    """The map without keyframes that the video contradicts, the others' tracks, and the frames left out.

    Frames around a misplaced keyframe are tracked from the next ones that are in their place.
    """
    nothing = np.zeros(0, np.int64)
    misplaced = find_misplaced_keyframes(camera.name, scene_map, tracks, criteria)
    if len(misplaced) == 0:
        return scene_map, tracks, nothing
    cache = TrackCache(tracks, sorted(select_keyframe_points(scene_map, camera.name)))
    remaining = map_without_keyframes(scene_map, misplaced)
    tracks = track_all(camera, select_keyframe_points(remaining, camera.name), cache, context)
    return remaining, tracks, scene_map.keyframe_frame[misplaced]


def _offered_keyframes(selection: KeyframeSelection, previous: Registration | None) -> IntArray:
    if previous is None:
        return np.asarray(selection.frames)
    return np.union1d(previous.tried_keyframes, previous.wanted_keyframes)


def _map_of_camera(maps: Sequence[Map], camera: str) -> Map | None:
    """The model with most of a camera's keyframes, or None."""
    counts = [len(item.keyframes_of(camera)) for item in maps]
    return maps[int(np.argmax(counts))] if counts and max(counts) > 0 else None


def acceptance_criteria(
    camera: CaptureCamera, selection: KeyframeSelection, options: RegistrationOptions
) -> AcceptanceCriteria:
    noise_px = np.hypot(_MAP_NOISE_PX * camera_pixel_scale(camera), 2.0 * selection.noise_px)
    return AcceptanceCriteria(
        max_error_px=float(_INLIER_SIGMAS * noise_px),
        min_inliers=options.min_inliers,
        max_sigma_depth=options.max_sigma_depth,
    )


def _registration_without_map(camera: CaptureCamera, offered: IntArray) -> Registration:
    no_tracks = Tracks.join_and_clear([])
    poses = [FramePose(status=FrameStatus.NO_MAP)] * len(camera.times_ns)
    return Registration(
        trajectory=build_trajectory(camera, "none", poses, np.zeros(len(poses))),
        obs_frame=no_tracks.frame,
        obs_keyframe=no_tracks.keyframe,
        obs_feature=no_tracks.feature,
        obs_px=no_tracks.px,
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=offered,
    )


def build_trajectory(
    camera: CaptureCamera, gauge: str, poses: Sequence[FramePose], sharpness: FloatArray
) -> Trajectory:
    missing = np.full((6, 6), np.nan)
    return Trajectory(
        camera=camera.name,
        gauge=gauge,
        frame_numbers=camera.frame_numbers,
        times_ns=camera.times_ns,
        gauge_from_cam=pose_array(poses),
        covariance=np.array(
            [missing if pose.covariance is None else pose.covariance for pose in poses]
        ).reshape(-1, 6, 6),
        status=tuple(_frame_statuses(poses, sharpness)),
        inliers=np.array([pose.inliers for pose in poses], dtype=np.int64),
        error_px=np.array([pose.error_px for pose in poses]),
    )


def _smooth_if_final(path: Trajectory) -> Trajectory:
    """Steadied, unless its lost frames are looked for first: that goes from poses as they were measured."""
    return smooth_weak_centres(path) if (~path.localised).sum() < LEAST_LOST else path


def _frame_statuses(poses: Sequence[FramePose], sharpness: FloatArray) -> list[FrameStatus]:
    """Statuses; a frame without tracks that is much less sharp than its surroundings is called blurred."""
    statuses = []
    for index, pose in enumerate(poses):
        status = pose.status
        if status is FrameStatus.FEW_TRACKS:
            nearby = sharpness[max(0, index - _BLUR_WINDOW_FRAMES) : index + _BLUR_WINDOW_FRAMES + 1]
            if sharpness[index] < _BLUR_RATIO * np.median(nearby):
                status = FrameStatus.BLUR
        statuses.append(status)
    return statuses
