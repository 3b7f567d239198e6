"""Recover the poses of lost frames from the appearance of map points and from the camera's motion."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.rotation_path import RotationPath, TurningShutter
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration.poses.contradicted import (
    contradicted_frames,
    find_folded_poses,
    withdraw_contradicted_poses,
)
from bodycap_batch.registration.poses.keyframe_requests import lost_intervals
from bodycap_batch.registration.poses.map_error import with_map_error, without_map_error
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria
from bodycap_batch.registration.poses.pose_outliers import ISOLATED_INLIER_FACTOR, isolated_poses
from bodycap_batch.registration.poses.registered_camera import RegisteredCamera
from bodycap_batch.registration.poses.turning_tracks import with_rotation
from bodycap_batch.registration.recovery.accepted_poses import accepted_pose, with_poses
from bodycap_batch.registration.recovery.guided_localisation import GuidedLocaliser, PoseEstimate, fuse
from bodycap_batch.registration.recovery.motion_prior import (
    MAX_DISAGREEMENT,
    MotionStatistics,
    PositionEstimate,
    SmoothedCentres,
    smooth_centres,
    times_in_intervals,
)
from bodycap_batch.registration.recovery.path_smoothing import smooth_weak_centres
from bodycap_batch.registration.recovery.preparation import (
    motion_statistics,
    prepare_recovery,
    remove_misplaced_keyframes,
)
from bodycap_batch.registration.recovery.propagation import LostInterval, Propagation
from bodycap_batch.registration.recovery.search_images import (
    estimate_exposure,
    read_keyframe_patches,
    read_pyramids,
)

_SMOOTHING_MARGIN = 8
"""Number of frames on either side of an interval that are smoothed together with it. Evidence: none."""
_MIN_SIGHT_LINES = 2
"""Minimum number of keyframes of other cameras that determine a point: two lines of sight."""
_MAX_PASSES = 5
"""Maximum number of passes over the lost intervals. Each pass starts from the poses of the previous pass, and
reaches frames deeper inside the intervals. Evidence: docs/decisions/registration.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownFrames:
    """What is known about the frames of a camera before the lost ones are searched.

    Attributes:
        rotation: The rotation of a camera with a rolling shutter from matches between adjacent frames; None
            if it is unknown.
        contradicted: (N,) True for frames in blocks of misplaced keyframes; None if there are none. Lost
            intervals with such frames are searched with `independent_localiser`.
    """

    rotation: RotationPath | None = None
    contradicted: BoolArray | None = None


_NOTHING_KNOWN = KnownFrames()
"""No rotation, and no misplaced keyframes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveryInputs:
    """The inputs of `recover_lost_frames`, except the registration of the camera to recover.

    Attributes:
        capture: All cameras. The first camera is the camera to recover.
        registrations: All cameras with their registrations, in the order of `capture`. `recover_lost_frames`
            holds only one of them at a time, so an iterable may load them one after another.
        maps: The maps that the cameras were registered against.
        selection: The keyframes of the camera to recover.
        misplaced: Frame indices of the keyframes of the camera to recover that contradict the map.
    """

    capture: Capture
    registrations: Iterable[RegisteredCamera]
    maps: Sequence[Map]
    selection: KeyframeSelection
    misplaced: Collection[int] = ()


def recover_lost_frames(
    registration: Registration, inputs: RecoveryInputs, options: RegistrationOptions, context: StageContext
) -> Registration:
    """Recover the poses of one camera's lost frames.

    First, misregistered keyframes of all cameras are removed from the map. Second, weak poses next to lost
    intervals are removed and the map points are refined. Third, the lost frames are searched.

    Args:
        registration: Registration of the camera, from tracking.
        inputs: All cameras, their registrations and the maps.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        context: Threads, progress and cancellation.

    Returns:
        The registration with more poses and a smoothed trajectory. It contains no observations of the
        recovered frames. A registration without a map is returned unchanged.
    """
    gauge = registration.trajectory.gauge
    own_map = next((scene for scene in inputs.maps if scene.gauge == gauge), None)
    if own_map is None:
        return registration
    registration = replace(registration, trajectory=without_map_error(registration.trajectory, inputs.maps))
    trajectories: list[Trajectory] = []

    def cameras() -> Iterable[RegisteredCamera]:
        for camera in inputs.registrations:
            trajectories.append(without_map_error(camera.registration.trajectory, inputs.maps))
            yield camera

    own = with_rotation(inputs.capture.cameras[0], registration, [own_map], inputs.selection)
    scene_map = remove_misplaced_keyframes(own_map, cameras(), inputs.selection, options)
    scene_map, registration = prepare_recovery(
        own, trajectories[1:], scene_map, inputs.selection, options, context.threads
    )
    registration = withdraw_contradicted_poses(registration, inputs.maps, inputs.misplaced)
    contradicted = contradicted_frames(registration.trajectory, inputs.maps, inputs.misplaced)
    known = KnownFrames(rotation=own.rotation, contradicted=contradicted)
    found = find_lost_poses(registration, scene_map, inputs.capture, options, context, known)
    return replace(found, trajectory=with_map_error(found.trajectory, inputs.maps))


def find_lost_poses(
    registration: Registration,
    scene_map: Map,
    capture: Capture,
    options: RegistrationOptions,
    context: StageContext,
    known: KnownFrames = _NOTHING_KNOWN,
) -> Registration:
    """Search the lost frames of a camera, and accept the poses that are well supported.

    Frames are searched one after another, from both ends of a lost interval and from the seeds in it. A seed
    is a keyframe whose pose was not accepted. In each frame the map points are searched near the pixels that
    follow from the predicted motion. The points are recognised by their appearance in keyframes of any
    camera.

    The centres found are smoothed together with the centres around the interval, because the acceleration of
    a body-worn camera changes little from frame to frame. A pose is accepted if enough points agree, if its
    centre is near the smoothed centre, and if its sigma is small. Lost intervals next to newly accepted poses
    are searched again, until no more poses are found or `_MAX_PASSES` passes are done.

    Args:
        registration: Registration of the camera, from tracking.
        scene_map: The map that the poses refer to.
        capture: All cameras.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        context: Progress and cancellation.
        known: What is known about the frames; nothing by default.

    Returns:
        The registration with more poses and a smoothed trajectory. It contains no observations of the
        recovered frames.
    """
    path = registration.trajectory
    camera = capture.camera(path.camera)
    lost, statistics = ~path.localised, motion_statistics(path)
    if statistics is None:
        return registration
    times = times_in_intervals(path.times_ns)
    localiser = make_localiser(scene_map, capture, path, options, context, known.rotation)
    interval_search = _IntervalSearch(
        camera=camera,
        scene_map=scene_map,
        localiser=localiser,
        independent=independent_localiser(localiser, camera.name),
        contradicted=np.zeros(len(lost), dtype=bool) if known.contradicted is None else known.contradicted,
        times=times,
        statistics=statistics,
        seed_rows=_seed_keyframes(scene_map, camera.name, lost),
        tracked_frames=frozenset(np.flatnonzero(~lost).tolist()),
    )
    frozen = np.array([status is FrameStatus.FROZEN for status in path.status], dtype=bool)
    intervals, position = lost_intervals(~lost | frozen), 0
    with ThreadPoolExecutor(context.threads, thread_name_prefix="intervals") as pool:
        for _ in range(_MAX_PASSES):
            if not intervals:
                break
            poses: dict[int, PoseEstimate] = {}
            # The intervals of one pass do not depend on each other.
            search = partial(_recover_unless_cancelled, interval_search, _localised_poses(path), context)
            for (start, _), found in zip(intervals, pool.map(search, intervals), strict=True):
                position = max(position, start)  # a new pass does not reduce the progress
                context.progress(position, len(lost), "lost frames searched")
                poses |= found
            before, path = path.localised, _merge_into(path, poses, localiser.criteria)
            intervals = _extended_intervals(path.localised, before, frozen)
    path = path.without(
        find_folded_poses(camera.rotation_chain, path.gauge_from_cam), FrameStatus.CONTRADICTED
    )
    return replace(registration, trajectory=smooth_weak_centres(path, ~lost))


def _recover_unless_cancelled(
    search: _IntervalSearch,
    poses: Mapping[int, PoseEstimate],
    context: StageContext,
    interval: tuple[int, int],
) -> dict[int, PoseEstimate]:
    """Return the accepted poses of one lost interval [start, stop); raise `Cancelled` if the task stops."""
    context.check_cancelled()
    return search.recover_interval(*interval, poses)


def make_localiser(
    scene_map: Map,
    capture: Capture,
    path: Trajectory,
    options: RegistrationOptions,
    context: StageContext,
    rotation: RotationPath | None,
) -> GuidedLocaliser:
    """Return a localiser with the keyframes of all cameras and the camera's exposure time."""
    camera = capture.camera(path.camera)
    criteria = AcceptanceCriteria(
        max_error_px=1.0, min_inliers=options.min_inliers, max_sigma_depth=options.max_sigma_depth
    )
    interval_s = float(np.median(np.diff(path.times_ns))) * 1e-9
    lens, readout_s = scene_map.cameras[camera.name], scene_map.readout_s.get(camera.name, 0.0)
    localiser = GuidedLocaliser(
        lens=lens,
        patches=read_keyframe_patches(scene_map, capture, camera, context),
        criteria=criteria,
        exposure_ratio=0.0,
        readout_ratio=readout_s / interval_s,
        shutter=None if rotation is None else TurningShutter(lens, rotation, readout_s),
        is_unmasked=camera.is_unmasked,
    )
    return replace(localiser, exposure_ratio=estimate_exposure(camera, localiser, path))


def independent_localiser(localiser: GuidedLocaliser, camera: str) -> GuidedLocaliser:
    """Return a localiser that uses only the points which other cameras determine.

    It is for frames around keyframes of the camera that contradict the map. Points that only this camera sees
    may have the same error as these keyframes: they agree with a wrong pose, however many they are. Without
    other cameras in the map, no such frame is found again. Evidence: docs/decisions/registration.md.

    Args:
        localiser: The localiser of the camera.
        camera: Camera name.
    """
    patches = localiser.patches
    scene = patches.scene_map
    is_other = np.array([name != camera for name in scene.keyframe_camera], dtype=bool)
    seen = np.bincount(scene.obs_point[is_other[scene.obs_keyframe]], minlength=len(scene.points))
    return replace(localiser, patches=replace(patches, usable=patches.usable & (seen >= _MIN_SIGHT_LINES)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _IntervalSearch:
    """The search for the lost frames of one camera.

    Attributes:
        camera: The camera.
        scene_map: The map.
        localiser: Estimates the pose of a frame near an expected pose.
        independent: The same for intervals with contradicted frames; see `independent_localiser`.
        contradicted: (N,) True for frames in blocks of misplaced keyframes.
        times: (N,) times of the frames, in units of the frame interval.
        statistics: How smoothly the camera moves.
        seed_rows: Row indices in the map by frame, for the lost frames that are keyframes.
        tracked_frames: Indices of the frames with a pose from tracking.
        turns: Rotations between frames that were measured so far. A further pass does not measure them again.
            Several threads may fill it, because each of them measures the same rotation.
    """

    camera: CaptureCamera
    scene_map: Map
    localiser: GuidedLocaliser
    independent: GuidedLocaliser
    contradicted: BoolArray
    times: FloatArray
    statistics: MotionStatistics
    seed_rows: Mapping[int, int]
    tracked_frames: Collection[int]
    turns: dict[tuple[int, int], FloatArray | None] = field(default_factory=dict)

    def recover_interval(
        self, start: int, stop: int, poses: Mapping[int, PoseEstimate]
    ) -> dict[int, PoseEstimate]:
        """Return the accepted poses of the lost frames [start, stop), by frame.

        Args:
            start: First lost frame.
            stop: One past the last lost frame.
            poses: Poses of the camera's localised frames, by frame.
        """
        seed_rows = {frame: row for frame, row in self.seed_rows.items() if start <= frame < stop}
        interval = LostInterval(
            start=start,
            stop=stop,
            times=self.times,
            pyramids=read_pyramids(self.camera, start, stop, sorted(seed_rows)),
            poses=poses,
            tracked_frames=self.tracked_frames,
            seed_poses={frame: invert(self.scene_map.map_from_cam[row]) for frame, row in seed_rows.items()},
            keyframe_rows=seed_rows,
            statistics=self.statistics,
        )
        localiser = self.independent if self.contradicted[start:stop].any() else self.localiser
        return _accepted_poses(Propagation(localiser, interval, self.turns))


def _extended_intervals(has_pose: BoolArray, before: BoolArray, frozen: BoolArray) -> list[tuple[int, int]]:
    """Return the lost intervals [start, stop) that are adjacent to a pose found in the last pass.

    Args:
        has_pose: (N,) True for frames that have a pose now.
        before: (N,) True for frames that had a pose before the last pass.
        frozen: (N,) True for frozen frames. They are not searched.
    """
    is_new = np.concatenate([[False], has_pose & ~before, [False]])
    intervals = lost_intervals(has_pose | frozen)
    return [(start, stop) for start, stop in intervals if is_new[start] or is_new[stop + 1]]


def _predicted_positions(interval: LostInterval) -> Mapping[int, PositionEstimate]:
    """Return the positions in an interval, by frame, that follow from the tracked frames around it."""
    frames = _frames_around(interval)
    tracked = [frame for frame in frames.tolist() if frame in interval.tracked_frames]
    positions = {frame: interval.poses[frame].position for frame in tracked if frame in interval.poses}
    if not positions:
        return {}
    smoothed = smooth_centres(
        frames, interval.times[frames], positions, positions.keys(), interval.statistics
    )
    return smoothed.positions


def _frames_around(interval: LostInterval) -> IntArray:
    """Return the frames of an interval and `_SMOOTHING_MARGIN` frames on either side."""
    first = max(0, interval.start - _SMOOTHING_MARGIN)
    return np.arange(first, min(len(interval.times), interval.stop + _SMOOTHING_MARGIN))


def _smooth(estimates: Mapping[int, PoseEstimate], interval: LostInterval) -> SmoothedCentres:
    """Smooth the centres of an interval together with the centres of the frames around it."""
    frames = _frames_around(interval)
    neighbours = {
        frame: interval.poses[frame].position for frame in frames.tolist() if frame in interval.poses
    }
    positions = neighbours | {frame: estimate.position for frame, estimate in estimates.items()}
    tracked = neighbours.keys() & interval.tracked_frames
    return smooth_centres(frames, interval.times[frames], positions, tracked, interval.statistics)


def _independent_position(
    estimate: PoseEstimate, smoothed: PositionEstimate, predicted: PositionEstimate | None
) -> PositionEstimate:
    """Return a smoothed position with a covariance from independent sources only.

    The sources are the picture of the frame and the motion of the tracked frames. The other found frames of
    the interval are not independent: each was searched near the pose of the frame beside it, so a wrong
    search continues in the next frames, and smoothing does not reduce this error. Evidence:
    docs/decisions/registration.md.

    Args:
        estimate: The pose from the picture of the frame.
        smoothed: The position, smoothed together with all found positions.
        predicted: The position that follows from the tracked frames alone; None if there are none.
    """
    own = estimate.position
    covariance = own.covariance if predicted is None else fuse(own, predicted)[0].covariance
    return PositionEstimate(smoothed.centre, covariance)


def _accepted_poses(propagation: Propagation) -> dict[int, PoseEstimate]:
    """Search an interval and return the accepted poses with smoothed centres, by frame.

    A pose is accepted if its centre is near the smoothed centre, and if `accepted_pose` accepts it.
    """
    estimates = propagation.run()
    if not estimates:
        return {}
    estimates = propagation.second_pass(estimates, _smooth(estimates, propagation.interval).positions)
    estimates = propagation.with_start_errors(estimates)
    smoothed = _smooth(estimates, propagation.interval)
    predicted = _predicted_positions(propagation.interval)
    accepted = {}
    for frame, estimate in estimates.items():
        if smoothed.disagreement[frame] < MAX_DISAGREEMENT:
            position = _independent_position(estimate, smoothed.positions[frame], predicted.get(frame))
            pose = accepted_pose(estimate, position, propagation.localiser, frame)
            if pose is not None:
                accepted[frame] = pose
    return accepted


def _merge_into(
    path: Trajectory, poses: Mapping[int, PoseEstimate], criteria: AcceptanceCriteria
) -> Trajectory:
    """Return the trajectory with additional poses. Isolated poses are not added."""
    merged = with_poses(path, poses)
    min_inliers = ISOLATED_INLIER_FACTOR * criteria.min_inliers
    isolated = isolated_poses(merged.localised, merged.inliers, min_inliers)
    isolated |= _single_poses(merged.localised)
    return with_poses(path, {frame: pose for frame, pose in poses.items() if not isolated[frame]})


def _single_poses(has_pose: BoolArray) -> BoolArray:
    """Return a mask (N,) of the frames with a pose between two frames without a pose."""
    padded = np.concatenate([[False], has_pose, [False]])
    return np.asarray(has_pose & ~padded[:-2] & ~padded[2:])


def _localised_poses(path: Trajectory) -> dict[int, PoseEstimate]:
    """Return the poses of a trajectory, by frame."""
    return {
        frame: PoseEstimate.from_trajectory(path, frame) for frame in np.flatnonzero(path.localised).tolist()
    }


def _seed_keyframes(scene_map: Map, camera: str, lost: BoolArray) -> dict[int, int]:
    """Return the row indices in the map, by frame, of a camera's lost frames that are keyframes."""
    rows = scene_map.keyframes_of(camera)
    frames = scene_map.keyframe_frame[rows]
    return {int(frame): int(row) for row, frame in zip(rows, frames, strict=True) if lost[frame]}
