"""Poses of lost frames, from what the map's points look like and from how the camera moves."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.config.lost_frames import LEAST_POSED
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.optical_flow import sharpness
from bodycap_batch.model.scene import FrameStatus, Map, Registration, Trajectory
from bodycap_batch.registration.poses.keyframe_requests import lost_intervals
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria
from bodycap_batch.registration.poses.pose_outliers import isolated_poses
from bodycap_batch.registration.poses.static_points import static_points
from bodycap_batch.registration.recovery.guided_localisation import GuidedLocaliser, PoseEstimate
from bodycap_batch.registration.recovery.motion_prior import MotionStatistics, SmoothedCentres, smooth_centres
from bodycap_batch.registration.recovery.patch_search import (
    KeyframePatches,
    PredictedView,
    Pyramid,
    SearchLevel,
    match_patches,
    select_patches,
)
from bodycap_batch.registration.recovery.path_smoothing import smooth_weak_centres
from bodycap_batch.registration.recovery.propagation import LostInterval, Propagation

_MAX_KEYFRAMES = 600
"""Keyframes held in memory, half a megabyte each."""
_SMOOTHING_MARGIN = 8
_MAX_DISTANCE_FRAMES, _MAX_FRAMES = 90, 400
"""Frames of a lost stretch from its ends or a seed that are looked at, and how many of them all in all: the
nearest; bounds memory."""
_EXPOSURE_CANDIDATES = (0.0, 0.3, 0.6)
_EXPOSURE_FRAMES = 4
_EXPOSURE_LEVEL = SearchLevel(pyramid_level=1, patch_side=21, search_radius=4, score=-1.0, limit_px=6.0)
_MIN_INLIER_WEIGHT_RATIO = 0.5
_MAX_DISAGREEMENT = 11.3
"""Squared Mahalanobis distance between where a frame was found and its smoothed place: 99 % of three axes."""
_LONE_EVIDENCE = 4
_MAX_PASSES = 5
"""A walk goes as far as motion leads it; from poses smoothed and vouched for it goes further, until nothing
more is found. Room131's right palm has 94 of 150 frames after the first round, 104 after the second, 108
in the end (off by 2.6 cm both), a rendered one with arms thrown about 105, 107, 108 of 120."""


def find_lost_poses(
    registration: Registration,
    scene_map: Map,
    capture: Capture,
    options: RegistrationOptions,
    context: StageContext,
) -> Registration:
    """Give lost frames the poses that can be vouched for.

    From both ends of a lost stretch, and from keyframes within it whose poses were not believed, the frames
    are walked through one after another: the map's points are looked for where the motion so far leads, as
    they look in keyframes of any camera. What is found is smoothed together with the poses around the
    stretch: a body-worn camera's centre has little change of acceleration from frame to frame. A frame gets
    a pose where enough points agree, its own place is near the smoothed one, and that is known well enough.
    What is still lost beside them is walked through again from there, until nothing more is found.

    Args:
        found: One camera's frames as tracking left them.
        scene_map: The map they were solved in.
        capture: All cameras.
        options: Limits.
        context: Progress, cancellation.

    Returns:
        The same with more poses, their observations not kept, and the path steadied.
    """
    path = registration.trajectory
    camera = capture.camera(path.camera)
    lost, statistics = ~path.localised, _motion_statistics(path)
    if statistics is None:
        return registration
    times = _times_in_intervals(path)
    localiser = _make_localiser(scene_map, capture, path, options, context)
    interval_search = _IntervalSearch(
        camera=camera,
        scene_map=scene_map,
        localiser=localiser,
        times=times,
        statistics=statistics,
        seed_rows=_seed_keyframes(scene_map, camera.name, lost),
        tracked_frames=frozenset(np.flatnonzero(~lost).tolist()),
    )
    intervals, position = lost_intervals(~lost), 0
    for _ in range(_MAX_PASSES):
        if not intervals:
            break
        poses: dict[int, PoseEstimate] = {}
        localised = _localised_poses(path)
        for start, stop in intervals:
            context.check_cancelled()
            position = max(position, start)  # a further round begins in front again
            context.progress(position, len(lost), "lost frames looked at")
            poses |= interval_search.recover_interval(start, stop, localised)
        before, path = path.localised, _merge_into(path, poses, localiser.criteria)
        intervals = _extended_intervals(path.localised, before)
    return replace(registration, trajectory=smooth_weak_centres(path, ~lost))


def can_recover(path: Trajectory) -> bool:
    """Whether a path has lost frames, and poses enough to look for them from."""
    return _motion_statistics(path) is not None


def _motion_statistics(path: Trajectory) -> MotionStatistics | None:
    """How evenly a camera moves; None where no frame is lost or too few have poses."""
    has_pose = path.localised
    if has_pose.all() or has_pose.sum() < LEAST_POSED:
        return None
    return MotionStatistics.estimate(_times_in_intervals(path), path.gauge_from_cam[:, :3, 3])


def _times_in_intervals(path: Trajectory) -> FloatArray:
    """(N,) in frame intervals, from the first one on."""
    times = (path.times_ns - path.times_ns[0]).astype(np.float64)
    return np.asarray(times / np.median(np.diff(times)))


def _make_localiser(
    scene_map: Map,
    capture: Capture,
    path: Trajectory,
    options: RegistrationOptions,
    context: StageContext,
) -> GuidedLocaliser:
    """What finds poses of a camera's frames."""
    camera = capture.camera(path.camera)
    criteria = AcceptanceCriteria(
        max_error_px=1.0, min_inliers=options.min_inliers, max_sigma_depth=options.max_sigma_depth
    )
    interval_s = float(np.median(np.diff(path.times_ns))) * 1e-9
    localiser = GuidedLocaliser(
        lens=scene_map.cameras[camera.name],
        patches=_keyframe_patches(scene_map, capture, camera, context),
        criteria=criteria,
        exposure_ratio=0.0,
        readout_ratio=scene_map.readout_s.get(camera.name, 0.0) / interval_s,
        is_unmasked=camera.is_unmasked,
    )
    return replace(localiser, exposure_ratio=_estimate_exposure(camera, localiser, path))


@dataclass(frozen=True, slots=True, kw_only=True)
class _IntervalSearch:
    """What looking for a camera's lost frames takes.

    Attributes:
        camera: The camera.
        scene_map: The map.
        finder: Finds poses.
        times: (N,) of its frames, in frame intervals.
        steadiness: How evenly it moves.
        seeds: Rows of the map's keyframes among its lost frames, by frame.
        tracked: Frames whose poses tracking found.
    """

    camera: CaptureCamera
    scene_map: Map
    localiser: GuidedLocaliser
    times: FloatArray
    statistics: MotionStatistics
    seed_rows: Mapping[int, int]
    tracked_frames: Collection[int]

    def recover_interval(
        self, start: int, stop: int, poses: Mapping[int, PoseEstimate]
    ) -> dict[int, PoseEstimate]:
        """Poses vouched for of the lost frames [start, stop) amid `poses` ones."""
        seed_rows = {frame: row for frame, row in self.seed_rows.items() if start <= frame < stop}
        interval = LostInterval(
            start=start,
            stop=stop,
            times=self.times,
            pyramids=_read_pyramids(self.camera, start, stop, sorted(seed_rows)),
            poses=poses,
            tracked_frames=self.tracked_frames,
            seed_poses={frame: invert(self.scene_map.map_from_cam[row]) for frame, row in seed_rows.items()},
            keyframe_rows=seed_rows,
            statistics=self.statistics,
        )
        return _accepted_poses(Propagation(self.localiser, interval), self.localiser.criteria)


def _extended_intervals(has_pose: BoolArray, before: BoolArray) -> list[tuple[int, int]]:
    """Stretches still lost at an end of which a pose was found."""
    is_new = np.concatenate([[False], has_pose & ~before, [False]])
    return [(start, stop) for start, stop in lost_intervals(has_pose) if is_new[start] or is_new[stop + 1]]


def _smooth(estimates: Mapping[int, PoseEstimate], interval: LostInterval) -> SmoothedCentres:
    """Places of a stretch's frames and of those around it."""
    first = max(0, interval.start - _SMOOTHING_MARGIN)
    frames = np.arange(first, min(len(interval.times), interval.stop + _SMOOTHING_MARGIN))
    neighbours = {
        frame: interval.poses[frame].position for frame in frames.tolist() if frame in interval.poses
    }
    positions = neighbours | {frame: estimate.position for frame, estimate in estimates.items()}
    tracked = neighbours.keys() & interval.tracked_frames
    return smooth_centres(frames, interval.times[frames], positions, tracked, interval.statistics)


def _accepted_poses(propagation: Propagation, criteria: AcceptanceCriteria) -> dict[int, PoseEstimate]:
    """Smoothed poses of the frames of a stretch that enough speaks for."""
    estimates = propagation.run()
    if not estimates:
        return {}
    estimates = propagation.second_pass(estimates, _smooth(estimates, propagation.interval).positions)
    smoothed = _smooth(estimates, propagation.interval)
    accepted = {}
    for frame, estimate in estimates.items():
        pose, covariance = estimate.conditioned_on_centre(smoothed.positions[frame])
        sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
        if (
            estimate.inliers >= criteria.min_inliers
            and estimate.inlier_weight_ratio >= _MIN_INLIER_WEIGHT_RATIO
            and smoothed.disagreement[frame] < _MAX_DISAGREEMENT
            and sigma < criteria.max_sigma_depth * estimate.depth
        ):
            accepted[frame] = replace(estimate, cam_from_map=pose, covariance=covariance)
    return accepted


def _merge_into(
    path: Trajectory, poses: Mapping[int, PoseEstimate], criteria: AcceptanceCriteria
) -> Trajectory:
    """A trajectory with more poses, without those that stand alone amid lost frames."""
    has_pose: BoolArray = path.localised.copy()
    inliers = path.inliers.copy()
    for frame, estimate in poses.items():
        has_pose[frame], inliers[frame] = True, estimate.inliers
    isolated = isolated_poses(has_pose, inliers, _LONE_EVIDENCE * criteria.min_inliers) | _single_poses(
        has_pose
    )
    matrices, covariance = path.gauge_from_cam.copy(), path.covariance.copy()
    status, error_px = list(path.status), path.error_px.copy()
    for frame, estimate in poses.items():
        if isolated[frame]:
            continue
        matrices[frame], covariance[frame] = invert(estimate.cam_from_map), estimate.covariance
        status[frame], error_px[frame] = FrameStatus.REGISTERED, estimate.error_px
    inliers = np.where([value.localised for value in status], inliers, path.inliers)
    return replace(
        path,
        gauge_from_cam=matrices,
        covariance=covariance,
        status=tuple(status),
        inliers=inliers,
        error_px=error_px,
    )


def _single_poses(has_pose: BoolArray) -> BoolArray:
    """(N,) frames with a pose that neither neighbour has."""
    padded = np.concatenate([[False], has_pose, [False]])
    return np.asarray(has_pose & ~padded[:-2] & ~padded[2:])


def _localised_poses(path: Trajectory) -> dict[int, PoseEstimate]:
    """Poses that tracking found, by frame."""
    return {frame: PoseEstimate.from_trajectory(path, frame) for frame in np.flatnonzero(path.localised).tolist()}


def _seed_keyframes(scene_map: Map, camera: str, lost: BoolArray) -> dict[int, int]:
    """Rows of the map's keyframes among a camera's lost frames, by frame."""
    rows = scene_map.keyframes_of(camera)
    frames = scene_map.keyframe_frame[rows]
    return {int(frame): int(row) for row, frame in zip(rows, frames, strict=True) if lost[frame]}


def _keyframe_patches(
    scene_map: Map, capture: Capture, camera: CaptureCamera, context: StageContext
) -> KeyframePatches:
    """The map's keyframes' pictures, of all cameras; evenly thinned out where they are very many."""
    count = len(scene_map.keyframe_camera)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_KEYFRAMES)).round().astype(int))
    pyramids: dict[int, Pyramid] = {}
    relative_sharpness = np.zeros(count)
    for name in sorted(set(scene_map.keyframe_camera)):
        rows = np.intersect1d(scene_map.keyframes_of(name), chosen)
        row_of = dict(zip(scene_map.keyframe_frame[rows].tolist(), rows.tolist(), strict=True))
        for frame, grey in capture.camera(name).read(sorted(row_of)):
            context.check_cancelled()
            row = row_of[frame]
            pyramids[row] = Pyramid.build(grey)
            context.progress(len(pyramids), len(chosen), "keyframes of all cameras decoded")
            relative_sharpness[row] = sharpness(pyramids[row].levels[0])
        relative_sharpness[rows] /= (
            max(float(np.median(relative_sharpness[rows])), 1e-9) if len(rows) else 1.0
        )
    keyframe_count: IntArray = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    usable = static_points(camera, scene_map)
    return KeyframePatches(
        scene_map=scene_map,
        pyramids=pyramids,
        sharpness=relative_sharpness,
        usable=usable,
        keyframe_count=keyframe_count,
    )


def _read_pyramids(
    camera: CaptureCamera, start: int, stop: int, seed_frames: list[int]
) -> dict[int, Pyramid]:
    """Frames of a lost stretch near its ends or a seed, and those on either side of it."""
    frames = np.arange(max(0, start - 1), min(len(camera.times_ns), stop + 1))
    reference_frames = np.array([start, stop - 1, *seed_frames])
    distance = np.abs(frames[:, None] - reference_frames).min(axis=1)
    nearest = np.argsort(distance, kind="stable")[:_MAX_FRAMES]
    frames = frames[np.sort(nearest[distance[nearest] <= _MAX_DISTANCE_FRAMES])]
    return {frame: Pyramid.build(grey) for frame, grey in camera.read(frames)}


def _estimate_exposure(camera: CaptureCamera, localiser: GuidedLocaliser, path: Trajectory) -> float:
    """Share of the time between two frames that the shutter is open, as blurred frames with poses show it."""
    has_pose = path.localised
    pairs = np.flatnonzero(has_pose[1:] & has_pose[:-1]) + 1
    rotations = path.gauge_from_cam[:, :3, :3]
    cosine = np.einsum("nij,nij->n", rotations[pairs - 1], rotations[pairs])
    fastest = np.sort(pairs[np.argsort(cosine, kind="stable")[:_EXPOSURE_FRAMES]])
    totals = np.zeros(len(_EXPOSURE_CANDIDATES))
    for frame, grey in camera.read(fastest):
        pose, neighbour_pose = (invert(path.gauge_from_cam[index]) for index in (frame, frame - 1))
        view = PredictedView(
            lens=localiser.lens,
            pyramid=Pyramid.build(grey),
            cam_from_map=pose,
            neighbour_pose=neighbour_pose,
            exposure_ratio=0.0,
            readout_ratio=localiser.readout_ratio,
        )
        rows = select_patches(localiser.patches, view)
        for number, ratio in enumerate(_EXPOSURE_CANDIDATES):
            matches = match_patches(
                localiser.patches, replace(view, exposure_ratio=ratio), rows, _EXPOSURE_LEVEL
            )
            totals[number] += matches.score[localiser.is_unmasked(matches.px)].sum()
    return _EXPOSURE_CANDIDATES[int(np.argmax(totals))]
