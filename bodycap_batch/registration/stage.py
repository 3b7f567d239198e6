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
from bodycap_batch.registration.poses.keyframe_requests import wanted_keyframes
from bodycap_batch.registration.poses.misplaced_keyframes import misplaced, without_keyframes
from bodycap_batch.registration.poses.pnp import FramePose, PoseLimits
from bodycap_batch.registration.poses.rig_members import RigCamera, first_poses, members_of, relative_poses
from bodycap_batch.registration.poses.trajectory import matrices, solve_frames, solve_rig
from bodycap_batch.registration.recovery.path_smoothing import steadied
from bodycap_batch.registration.recovery.point_refinement import settled_points, without_weak_ends
from bodycap_batch.registration.recovery.recover import recoverable
from bodycap_batch.registration.tracking.frame_ranges import Known, all_tracks
from bodycap_batch.registration.tracking.klt import Tracks, anchors_of, track_scale

_MAP_NOISE_PX = 0.6
_THRESHOLD_SIGMAS = 3.5
_BLUR_RATIO = 0.6
_BLUR_WINDOW = 15


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
    tried = _tried(selection, previous)
    scene_map = _own_map(maps, camera.name)
    if scene_map is None:
        return _without_map(camera, tried)
    limits = _limits(camera, selection, options)
    tracks = all_tracks(camera, anchors_of(scene_map, camera.name), Known.of(previous), context)
    context.progress(0, 0, "misplaced keyframes")
    scene_map, tracks, doubtful = _without_misplaced(camera, scene_map, tracks, limits, context)
    context.progress(0, 0, "poses")
    poses = solve_frames(camera, scene_map, tracks, limits)
    trajectory = _finished(_trajectory(camera, scene_map.gauge, poses, selection.sharpness))
    asked = np.zeros(0, np.int64) if previous is None else previous.wanted_keyframes
    lost = wanted_keyframes(trajectory.localised, selection.sharpness, tried)
    return Registration(
        trajectory=trajectory,
        obs_frame=tracks.frame,
        obs_keyframe=tracks.keyframe,
        obs_feature=tracks.feature,
        obs_px=tracks.px,
        wanted_keyframes=np.union1d(lost, np.setdiff1d(doubtful, asked)),
        tried_keyframes=tried,
    )


def register_in_rig(
    own: RigCamera,
    others: Sequence[RigCamera],
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
    relative = relative_poses(own, others)
    members = members_of(own, others, relative)
    scene_map = next((each for each in maps if each.gauge == own.found.trajectory.gauge), None)
    if scene_map is None or len(members) == 1:
        return own.found, relative
    limits = _limits(own.camera, selection, options)
    for member in members:
        wrong = misplaced(member.camera.name, scene_map, member.tracks, limits)
        scene_map = without_keyframes(scene_map, wrong)
    poses = solve_rig(members, scene_map, first_poses(own, others, members), limits)
    trajectory = _finished(_trajectory(own.camera, scene_map.gauge, poses, selection.sharpness))
    return replace(own.found, trajectory=trajectory), relative


def without_contradicted(
    scene_map: Map, cameras: Iterable[RigCamera], selection: KeyframeSelection, options: RegistrationOptions
) -> Map:
    """The map without keyframes that the video of one of its cameras contradicts.

    Args:
        scene_map: The map.
        cameras: With their registrations; those against another map are passed over.
        selection: Keyframes of one of them; the noise of tracks is read from it.
        options: Limits.
    """
    wrong: list[IntArray] = []
    for each in cameras:
        if each.found.trajectory.gauge == scene_map.gauge:
            limits = _limits(each.camera, selection, options)
            wrong.append(misplaced(each.camera.name, scene_map, each.tracks, limits))
    return without_keyframes(scene_map, np.concatenate([np.zeros(0, np.int64), *wrong]))


def settled(
    own: RigCamera,
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
    before = [own.found.trajectory, *(path for path in others if path.gauge == scene_map.gauge)]
    paths = [without_weak_ends(path, options.min_inliers) for path in before]
    none_taken = all(path is known for path, known in zip(paths, before, strict=True))
    if none_taken or not recoverable(paths[0]):
        return scene_map, own.found
    settled_map = settled_points(scene_map, paths)
    limits = _limits(own.camera, selection, options)
    poses = solve_frames(own.camera, settled_map, own.tracks, limits)
    path = _trajectory(own.camera, scene_map.gauge, poses, selection.sharpness)
    path = without_weak_ends(path, options.min_inliers)
    if not recoverable(path):
        return scene_map, own.found
    return settled_map, replace(own.found, trajectory=path)


def _without_misplaced(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, limits: PoseLimits, context: StageContext
) -> tuple[Map, Tracks, IntArray]:
    """The map without keyframes that the video contradicts, the others' tracks, and the frames left out.

    Frames around a misplaced keyframe are tracked from the next ones that are in their place.
    """
    none = np.zeros(0, np.int64)
    wrong = misplaced(camera.name, scene_map, tracks, limits)
    if len(wrong) == 0:
        return scene_map, tracks, none
    known = Known(tracks, sorted(anchors_of(scene_map, camera.name)))
    rest = without_keyframes(scene_map, wrong)
    tracks = all_tracks(camera, anchors_of(rest, camera.name), known, context)
    return rest, tracks, scene_map.keyframe_frame[wrong]


def _tried(selection: KeyframeSelection, previous: Registration | None) -> IntArray:
    if previous is None:
        return np.asarray(selection.frames)
    return np.union1d(previous.tried_keyframes, previous.wanted_keyframes)


def _own_map(maps: Sequence[Map], camera: str) -> Map | None:
    """The model with most of a camera's keyframes, or None."""
    counts = [len(item.keyframes_of(camera)) for item in maps]
    return maps[int(np.argmax(counts))] if counts and max(counts) > 0 else None


def _limits(camera: CaptureCamera, selection: KeyframeSelection, options: RegistrationOptions) -> PoseLimits:
    noise_px = np.hypot(_MAP_NOISE_PX * track_scale(camera), 2.0 * selection.noise_px)
    return PoseLimits(
        max_error_px=float(_THRESHOLD_SIGMAS * noise_px),
        min_inliers=options.min_inliers,
        max_sigma_depth=options.max_sigma_depth,
    )


def _without_map(camera: CaptureCamera, tried: IntArray) -> Registration:
    none = Tracks.join([])
    poses = [FramePose(status=FrameStatus.NO_MAP)] * len(camera.times_ns)
    return Registration(
        trajectory=_trajectory(camera, "none", poses, np.zeros(len(poses))),
        obs_frame=none.frame,
        obs_keyframe=none.keyframe,
        obs_feature=none.feature,
        obs_px=none.px,
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=tried,
    )


def _trajectory(
    camera: CaptureCamera, gauge: str, poses: Sequence[FramePose], sharpness: FloatArray
) -> Trajectory:
    none6 = np.full((6, 6), np.nan)
    return Trajectory(
        camera=camera.name,
        gauge=gauge,
        frame_numbers=camera.frame_numbers,
        times_ns=camera.times_ns,
        gauge_from_cam=matrices(poses),
        covariance=np.array(
            [none6 if pose.covariance is None else pose.covariance for pose in poses]
        ).reshape(-1, 6, 6),
        status=tuple(_blamed(poses, sharpness)),
        inliers=np.array([pose.inliers for pose in poses], dtype=np.int64),
        error_px=np.array([pose.error_px for pose in poses]),
    )


def _finished(path: Trajectory) -> Trajectory:
    """Steadied, unless its lost frames are looked for first: that goes from poses as they were measured."""
    return steadied(path) if (~path.localised).sum() < LEAST_LOST else path


def _blamed(poses: Sequence[FramePose], sharpness: FloatArray) -> list[FrameStatus]:
    """Statuses; a frame without tracks that is much less sharp than its surroundings is called blurred."""
    out = []
    for index, pose in enumerate(poses):
        status = pose.status
        if status is FrameStatus.FEW_TRACKS:
            near = sharpness[max(0, index - _BLUR_WINDOW) : index + _BLUR_WINDOW + 1]
            if sharpness[index] < _BLUR_RATIO * np.median(near):
                status = FrameStatus.BLUR
        out.append(status)
    return out
