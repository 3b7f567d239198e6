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
_EXPOSURE_LEVEL = SearchLevel(level=1, side=21, radius=4, score=-1.0, limit_px=6.0)
_MIN_INLIER_WEIGHT_RATIO = 0.5
_MAX_DISAGREEMENT = 11.3
"""Squared Mahalanobis distance between where a frame was found and its smoothed place: 99 % of three axes."""
_LONE_EVIDENCE = 4
_MAX_PASSES = 5
"""A walk goes as far as motion leads it; from poses smoothed and vouched for it goes further, until nothing
more is found. Room131's right palm has 94 of 150 frames after the first round, 104 after the second, 108
in the end (off by 2.6 cm both), a rendered one with arms thrown about 105, 107, 108 of 120."""


def find_lost_poses(
    found: Registration,
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
    path = found.trajectory
    camera = capture.camera(path.camera)
    lost, steadiness = ~path.localised, _motion_statistics(path)
    if steadiness is None:
        return found
    times = _times_in_intervals(path)
    finder = _make_localiser(scene_map, capture, path, options, context)
    search = _IntervalSearch(
        camera=camera,
        scene_map=scene_map,
        finder=finder,
        times=times,
        steadiness=steadiness,
        seeds=_seed_keyframes(scene_map, camera.name, lost),
        tracked=frozenset(np.flatnonzero(~lost).tolist()),
    )
    stretches, reached = lost_intervals(~lost), 0
    for _ in range(_MAX_PASSES):
        if not stretches:
            break
        poses: dict[int, PoseEstimate] = {}
        known = _localised_poses(path)
        for start, stop in stretches:
            context.check_cancelled()
            reached = max(reached, start)  # a further round begins in front again
            context.progress(reached, len(lost), "lost frames looked at")
            poses |= search.within(start, stop, known)
        before, path = path.localised, _merge_into(path, poses, finder.limits)
        stretches = _extended_intervals(path.localised, before)
    return replace(found, trajectory=smooth_weak_centres(path, ~lost))


def can_recover(path: Trajectory) -> bool:
    """Whether a path has lost frames, and poses enough to look for them from."""
    return _motion_statistics(path) is not None


def _motion_statistics(path: Trajectory) -> MotionStatistics | None:
    """How evenly a camera moves; None where no frame is lost or too few have poses."""
    posed = path.localised
    if posed.all() or posed.sum() < LEAST_POSED:
        return None
    return MotionStatistics.of(_times_in_intervals(path), path.gauge_from_cam[:, :3, 3])


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
    limits = AcceptanceCriteria(
        max_error_px=1.0, min_inliers=options.min_inliers, max_sigma_depth=options.max_sigma_depth
    )
    interval_s = float(np.median(np.diff(path.times_ns))) * 1e-9
    finder = GuidedLocaliser(
        lens=scene_map.cameras[camera.name],
        gallery=_keyframe_patches(scene_map, capture, camera, context),
        limits=limits,
        exposure=0.0,
        readout=scene_map.readout_s.get(camera.name, 0.0) / interval_s,
        sees_room=camera.sees_room,
    )
    return replace(finder, exposure=_estimate_exposure(camera, finder, path))


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
    finder: GuidedLocaliser
    times: FloatArray
    steadiness: MotionStatistics
    seeds: Mapping[int, int]
    tracked: Collection[int]

    def within(self, start: int, stop: int, known: Mapping[int, PoseEstimate]) -> dict[int, PoseEstimate]:
        """Poses vouched for of the lost frames [start, stop) amid `known` ones."""
        inside = {frame: row for frame, row in self.seeds.items() if start <= frame < stop}
        stretch = LostInterval(
            start=start,
            stop=stop,
            times=self.times,
            pyramids=_read_pyramids(self.camera, start, stop, sorted(inside)),
            known=known,
            tracked=self.tracked,
            seeds={frame: invert(self.scene_map.map_from_cam[row]) for frame, row in inside.items()},
            rows=inside,
            steadiness=self.steadiness,
        )
        return _accepted_poses(Propagation(self.finder, stretch), self.finder.limits)


def _extended_intervals(posed: BoolArray, before: BoolArray) -> list[tuple[int, int]]:
    """Stretches still lost at an end of which a pose was found."""
    fresh = np.concatenate([[False], posed & ~before, [False]])
    return [(start, stop) for start, stop in lost_intervals(posed) if fresh[start] or fresh[stop + 1]]


def _smooth(fixes: Mapping[int, PoseEstimate], stretch: LostInterval) -> SmoothedCentres:
    """Places of a stretch's frames and of those around it."""
    first = max(0, stretch.start - _SMOOTHING_MARGIN)
    frames = np.arange(first, min(len(stretch.times), stretch.stop + _SMOOTHING_MARGIN))
    around = {frame: stretch.known[frame].place for frame in frames.tolist() if frame in stretch.known}
    found = around | {frame: fix.place for frame, fix in fixes.items()}
    trusted = around.keys() & stretch.tracked
    return smooth_centres(frames, stretch.times[frames], found, trusted, stretch.steadiness)


def _accepted_poses(march: Propagation, limits: AcceptanceCriteria) -> dict[int, PoseEstimate]:
    """Smoothed poses of the frames of a stretch that enough speaks for."""
    fixes = march.run()
    if not fixes:
        return {}
    fixes = march.again(fixes, _smooth(fixes, march.stretch).places)
    smoothed = _smooth(fixes, march.stretch)
    out = {}
    for frame, fix in fixes.items():
        pose, covariance = fix.with_place(smoothed.places[frame])
        sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
        if (
            fix.inliers >= limits.min_inliers
            and fix.evidence >= _MIN_INLIER_WEIGHT_RATIO
            and smoothed.disagreement[frame] < _MAX_DISAGREEMENT
            and sigma < limits.max_sigma_depth * fix.depth
        ):
            out[frame] = replace(fix, cam_from_map=pose, covariance=covariance)
    return out


def _merge_into(
    path: Trajectory, poses: Mapping[int, PoseEstimate], limits: AcceptanceCriteria
) -> Trajectory:
    """A trajectory with more poses, without those that stand alone amid lost frames."""
    posed: BoolArray = path.localised.copy()
    inliers = path.inliers.copy()
    for frame, fix in poses.items():
        posed[frame], inliers[frame] = True, fix.inliers
    lone = isolated_poses(posed, inliers, _LONE_EVIDENCE * limits.min_inliers) | _single_poses(posed)
    matrices, covariance = path.gauge_from_cam.copy(), path.covariance.copy()
    status, error_px = list(path.status), path.error_px.copy()
    for frame, fix in poses.items():
        if lone[frame]:
            continue
        matrices[frame], covariance[frame] = invert(fix.cam_from_map), fix.covariance
        status[frame], error_px[frame] = FrameStatus.REGISTERED, fix.error_px
    inliers = np.where([each.localised for each in status], inliers, path.inliers)
    return replace(
        path,
        gauge_from_cam=matrices,
        covariance=covariance,
        status=tuple(status),
        inliers=inliers,
        error_px=error_px,
    )


def _single_poses(posed: BoolArray) -> BoolArray:
    """(N,) frames with a pose that neither neighbour has."""
    padded = np.concatenate([[False], posed, [False]])
    return np.asarray(posed & ~padded[:-2] & ~padded[2:])


def _localised_poses(path: Trajectory) -> dict[int, PoseEstimate]:
    """Poses that tracking found, by frame."""
    return {frame: PoseEstimate.of(path, frame) for frame in np.flatnonzero(path.localised).tolist()}


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
    held = np.unique(np.linspace(0, count - 1, min(count, _MAX_KEYFRAMES)).round().astype(int))
    pictures: dict[int, Pyramid] = {}
    sharp = np.zeros(count)
    for name in sorted(set(scene_map.keyframe_camera)):
        rows = np.intersect1d(scene_map.keyframes_of(name), held)
        row_of = dict(zip(scene_map.keyframe_frame[rows].tolist(), rows.tolist(), strict=True))
        for frame, grey in capture.camera(name).read(sorted(row_of)):
            context.check_cancelled()
            row = row_of[frame]
            pictures[row] = Pyramid.of(grey)
            context.progress(len(pictures), len(held), "keyframes of all cameras decoded")
            sharp[row] = sharpness(pictures[row].levels[0])
        sharp[rows] /= max(float(np.median(sharp[rows])), 1e-9) if len(rows) else 1.0
    seen: IntArray = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    usable = static_points(camera, scene_map)
    return KeyframePatches(scene_map=scene_map, pictures=pictures, sharpness=sharp, usable=usable, seen=seen)


def _read_pyramids(camera: CaptureCamera, start: int, stop: int, seeds: list[int]) -> dict[int, Pyramid]:
    """Frames of a lost stretch near its ends or a seed, and those on either side of it."""
    frames = np.arange(max(0, start - 1), min(len(camera.times_ns), stop + 1))
    near = np.array([start, stop - 1, *seeds])
    away = np.abs(frames[:, None] - near).min(axis=1)
    nearest = np.argsort(away, kind="stable")[:_MAX_FRAMES]
    frames = frames[np.sort(nearest[away[nearest] <= _MAX_DISTANCE_FRAMES])]
    return {frame: Pyramid.of(grey) for frame, grey in camera.read(frames)}


def _estimate_exposure(camera: CaptureCamera, finder: GuidedLocaliser, path: Trajectory) -> float:
    """Share of the time between two frames that the shutter is open, as blurred frames with poses show it."""
    posed = path.localised
    pairs = np.flatnonzero(posed[1:] & posed[:-1]) + 1
    turned = path.gauge_from_cam[:, :3, :3]
    cosine = np.einsum("nij,nij->n", turned[pairs - 1], turned[pairs])
    fastest = np.sort(pairs[np.argsort(cosine, kind="stable")[:_EXPOSURE_FRAMES]])
    totals = np.zeros(len(_EXPOSURE_CANDIDATES))
    for frame, grey in camera.read(fastest):
        pose, before = (invert(path.gauge_from_cam[each]) for each in (frame, frame - 1))
        view = PredictedView(
            lens=finder.lens,
            pyramid=Pyramid.of(grey),
            cam_from_map=pose,
            before=before,
            exposure=0.0,
            readout=finder.readout,
        )
        rows = select_patches(finder.gallery, view)
        for number, share in enumerate(_EXPOSURE_CANDIDATES):
            found = match_patches(finder.gallery, replace(view, exposure=share), rows, _EXPOSURE_LEVEL)
            totals[number] += found.score[finder.sees_room(found.px)].sum()
    return _EXPOSURE_CANDIDATES[int(np.argmax(totals))]
