"""From where frames have poses into the stretches where they were lost, one frame after another."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import interpolate_pose, invert, make_transform
from bodycap_batch.model.optical_flow import (
    apply_homography,
    detect_corners,
    estimate_coarse_motion,
    fit_rotation,
    make_coarse_image,
    unit_directions,
)
from bodycap_batch.registration.recovery.guided_localisation import (
    GuidedLocaliser,
    NeighbourPose,
    PoseEstimate,
    SearchFrame,
    fuse,
)
from bodycap_batch.registration.recovery.motion_prior import (
    CentreKalmanFilter,
    MotionStatistics,
    PositionEstimate,
)
from bodycap_batch.registration.recovery.patch_search import Pyramid

_MIN_INLIERS, _MIN_INLIER_WEIGHT_RATIO = 10, 0.45
_SEED_MIN_INLIERS, _SEED_MIN_INLIER_WEIGHT_RATIO = 15, 0.5
_MAX_PREDICTION_DISTANCE = 16.0
"""Squared Mahalanobis distance from where the motion leads: 99.9 % of three axes."""
_MAX_MISSES = 3
"""Frames in a row that are not found, after which a stretch is left: by then the prediction is off by more
than is searched."""
_SEED_SIGMA_JERKS = 40.0
_INITIAL_FRAMES = 6
_MAX_CORNERS, _CORNER_SPACING_PX, _GRID_SIDE = 48, 12.0, 4


@dataclass(frozen=True, slots=True, kw_only=True)
class LostInterval:
    """A lost stretch and what is around it.

    Attributes:
        start: Its first frame.
        stop: One past its last.
        times: (N,) of all the camera's frames, in frame intervals.
        pyramids: Pictures by frame, of the frames on either side too.
        known: Poses around it, by frame.
        tracked: Frames whose poses tracking found.
        seeds: Poses cam_from_map (4,4) within it that are not believed.
        rows: Their rows in the map, by frame.
        steadiness: How evenly the camera moves.
    """

    start: int
    stop: int
    times: FloatArray
    pyramids: Mapping[int, Pyramid]
    poses: Mapping[int, PoseEstimate]
    tracked_frames: Collection[int]
    seed_poses: Mapping[int, FloatArray]
    keyframe_rows: Mapping[int, int]
    statistics: MotionStatistics

    def search_frame(self, frame: int) -> SearchFrame:
        """A frame of which the picture is held."""
        return SearchFrame(self.pyramids[frame], self.keyframe_rows.get(frame, -1))


@dataclass(slots=True)
class _PropagationState:
    """Where a walk has come to: the last frame, its pose and its turn from the one before."""

    frame: int
    pose: FloatArray
    rotation_step: FloatArray
    motion_filter: CentreKalmanFilter


@dataclass(slots=True)
class Propagation:
    """Walks through a stretch from all sides.

    Attributes:
        finder: Finds poses.
        stretch: The stretch.
        fixes: What was found, by direction and frame.
    """

    localiser: GuidedLocaliser
    interval: LostInterval
    estimates: dict[tuple[int, int], PoseEstimate] = field(default_factory=dict)

    def run(self) -> dict[int, PoseEstimate]:
        """The best pose found for each frame, walking in from both ends and out from the seeds."""
        interval = self.interval
        for direction, end in ((1, interval.start - 1), (-1, interval.stop)):
            if end in interval.poses:
                self._propagate(self._initialised(end, direction), direction)
        for frame, prior in sorted(interval.seed_poses.items()):
            if (
                (1, frame) in self.estimates
                or (-1, frame) in self.estimates
                or frame not in interval.pyramids
            ):
                continue
            covariance = np.eye(3) * (_SEED_SIGMA_JERKS * interval.statistics.jerk_sigma) ** 2
            expected = PositionEstimate(invert(prior)[:3, 3], covariance)
            estimate = self.localiser.localise(
                interval.search_frame(frame), [prior], NeighbourPose(prior), expected
            )
            if (
                estimate is None
                or estimate.inliers < _SEED_MIN_INLIERS
                or estimate.inlier_weight_ratio < _SEED_MIN_INLIER_WEIGHT_RATIO
            ):
                continue
            for direction in (1, -1):
                self.estimates[direction, frame] = estimate
                motion_filter = CentreKalmanFilter(interval.statistics, estimate.position)
                self._propagate(
                    _PropagationState(frame, estimate.cam_from_map, np.eye(3), motion_filter), direction
                )
        best: dict[int, PoseEstimate] = {}
        for (_, frame), estimate in sorted(self.estimates.items()):
            other = best.get(frame)
            if (
                other is None
                or estimate.inliers * estimate.inlier_weight_ratio > other.inliers * other.inlier_weight_ratio
            ):
                best[frame] = estimate
        return best

    def second_pass(
        self, estimates: Mapping[int, PoseEstimate], positions: Mapping[int, PositionEstimate]
    ) -> dict[int, PoseEstimate]:
        """Look once more from smoothed places, and between two frames of which one was missed.

        Args:
            fixes: What `run` found.
            places: Smoothed places of these frames and those around them.
        """
        accepted = {}
        poses = {
            frame: estimate.conditioned_on_centre(positions[frame])[0]
            for frame, estimate in estimates.items()
        }
        poses |= {frame: estimate.cam_from_map for frame, estimate in self.interval.poses.items()}
        for frame in range(self.interval.start, self.interval.stop):
            before, after = poses.get(frame - 1), poses.get(frame + 1)
            estimate: PoseEstimate | None = None
            if frame not in self.interval.pyramids:
                continue
            search_frame = self.interval.search_frame(frame)
            if frame in estimates:
                estimate = self.localiser.relocalise(
                    search_frame, poses[frame], _neighbour_pose(before, after, poses[frame])
                )
                estimate = max(
                    estimates[frame],
                    estimate or estimates[frame],
                    key=lambda each: each.inliers * each.inlier_weight_ratio,
                )
            elif before is not None and after is not None:
                halfway = invert(interpolate_pose(invert(before), invert(after), 0.5))
                rotation = halfway[:3, :3]
                prior = make_transform(rotation, -rotation @ positions[frame].centre)
                estimate = self.localiser.localise(
                    search_frame, [prior], NeighbourPose(before), positions[frame]
                )
            if (
                estimate is not None
                and estimate.inliers >= _MIN_INLIERS
                and estimate.inlier_weight_ratio >= _MIN_INLIER_WEIGHT_RATIO
            ):
                accepted[frame] = estimate
        return accepted

    def _initialised(self, end: int, direction: int) -> _PropagationState:
        """A walk that has come through the frames with poses up to an end of the stretch."""
        poses = self.interval.poses
        candidates = [end - direction * number for number in range(_INITIAL_FRAMES)]
        gap = next((number for number, frame in enumerate(candidates) if frame not in poses), _INITIAL_FRAMES)
        frames = candidates[:gap][::-1]
        motion_filter = CentreKalmanFilter(self.interval.statistics, poses[frames[0]].position)
        for last, frame in pairwise(frames):
            motion_filter.predict(abs(self.interval.times[frame] - self.interval.times[last]))
            motion_filter.update(poses[frame].position)
        rotations = [poses[frame].cam_from_map[:3, :3] for frame in frames[-2:]]
        rotation_step = rotations[1] @ rotations[0].T if len(rotations) == 2 else np.eye(3)
        return _PropagationState(end, poses[end].cam_from_map, rotation_step, motion_filter)

    def _propagate(self, state: _PropagationState, direction: int) -> None:
        interval, misses = self.interval, 0
        while misses <= _MAX_MISSES:
            frame = state.frame + direction
            inside = interval.start <= frame < interval.stop and frame in interval.pyramids
            if not inside or (direction, frame) in self.estimates:
                return
            predicted = state.motion_filter.predict(abs(interval.times[frame] - interval.times[state.frame]))
            priors = [
                make_transform(rotation, -rotation @ predicted.centre)
                for rotation in self._candidate_rotations(state, frame)
            ]
            neighbour = NeighbourPose(state.pose, direction)
            estimate = self.localiser.localise(interval.search_frame(frame), priors, neighbour, predicted)
            state.frame = frame
            is_supported = (
                estimate is not None
                and estimate.inliers >= _MIN_INLIERS
                and estimate.inlier_weight_ratio >= _MIN_INLIER_WEIGHT_RATIO
            )
            fused, distance = (predicted, np.inf) if estimate is None else fuse(estimate.position, predicted)
            if estimate is None or not is_supported or distance >= _MAX_PREDICTION_DISTANCE:
                misses += 1
                state.pose = priors[0]
                continue
            self.estimates[direction, frame] = estimate
            state.motion_filter.update(estimate.position)
            pose, _ = estimate.conditioned_on_centre(fused)
            state.rotation_step, state.pose, misses = pose[:3, :3] @ state.pose[:3, :3].T, pose, 0

    def _candidate_rotations(self, state: _PropagationState, frame: int) -> list[FloatArray]:
        """Rotations (3,3) the next frame may have: as the image turned, and as the camera turned before."""
        rotation, lens = state.pose[:3, :3], self.localiser.lens
        previous_pyramid, pyramid = self.interval.pyramids.get(state.frame), self.interval.pyramids[frame]
        constant_rotation = [state.rotation_step @ rotation]
        if previous_pyramid is None:
            return constant_rotation
        first, second = make_coarse_image(previous_pyramid.levels[0]), make_coarse_image(pyramid.levels[0])
        width = lens.width_px
        corners = detect_corners(first, _MAX_CORNERS, _CORNER_SPACING_PX)
        motion = estimate_coarse_motion(first, second, corners * np.float32(width / first.shape[1]), width)
        if motion is None:
            return constant_rotation
        fractions = np.linspace(0.2, 0.8, _GRID_SIDE)
        grid = np.stack(np.meshgrid(fractions * width, fractions * lens.height_px), axis=-1).reshape(-1, 2)
        arrived = apply_homography(grid.astype(np.float32), motion.homography).astype(np.float64)
        inside = ((arrived > 0.0) & (arrived < (width, lens.height_px))).all(axis=1)
        if inside.sum() < _GRID_SIDE:
            return constant_rotation
        before, after = (unit_directions(lens.unproject(px[inside])) for px in (grid, arrived))
        return [fit_rotation(before, after) @ rotation, *constant_rotation]


def _neighbour_pose(before: FloatArray | None, after: FloatArray | None, pose: FloatArray) -> NeighbourPose:
    """The frame before, else the one after, else one as if the camera stood."""
    if before is not None:
        return NeighbourPose(before)
    return NeighbourPose(pose) if after is None else NeighbourPose(after, -1)
