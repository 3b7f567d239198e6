"""Propagate poses into a lost interval, frame by frame, from the frames with poses around it."""

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
"""Least inliers, and least inlier weight ratio, of a pose that the propagation continues from. Evidence:
none."""
_SEED_MIN_INLIERS, _SEED_MIN_INLIER_WEIGHT_RATIO = 15, 0.5
"""Least inliers, and least inlier weight ratio, of a pose at a seed. No motion supports it. Evidence:
none."""
_MAX_PREDICTION_DISTANCE = 16.0
"""Squared Mahalanobis distance between the found and the predicted centre. Origin: 99.9 % of a chi-squared
variable with three degrees of freedom."""
_MAX_MISSES = 3
"""Successive frames without a pose after which a propagation ends. The prediction is then off by more than
the search range. Evidence: none."""
_SEED_SIGMA_JERKS = 40.0
"""Sigma of a seed's centre along each axis, in units of the camera's jerk sigma. Evidence: none."""
_INITIAL_FRAMES = 6
"""Most frames before an interval that initialise the motion filter. Evidence: none."""
_MAX_CORNERS, _CORNER_SPACING_PX, _GRID_SIDE = 48, 12.0, 4
"""Corners for the image motion, their least distance in pixels of the reduced image, and points along each
side of the grid to which the camera's rotation is fitted. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LostInterval:
    """A lost interval and the frames around it.

    Attributes:
        start: First lost frame.
        stop: One past the last lost frame.
        times: (N,) times of all frames of the camera, in frame intervals.
        pyramids: Images by frame, including the frames on either side.
        poses: Poses around the interval, by frame.
        tracked_frames: Frames with a pose from tracking.
        seed_poses: Poses cam_from_map (4,4) of keyframes in the interval that were not accepted, by frame.
        keyframe_rows: Rows of these keyframes in the map, by frame.
        statistics: How smoothly the camera moves.
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
        """Return a frame with its image."""
        return SearchFrame(self.pyramids[frame], self.keyframe_rows.get(frame, -1))


@dataclass(slots=True)
class _PropagationState:
    """State of a propagation.

    Attributes:
        frame: The last frame.
        pose: (4,4) its pose cam_from_map.
        rotation_step: (3,3) its rotation from the frame before.
        motion_filter: Filter of the centre.
    """

    frame: int
    pose: FloatArray
    rotation_step: FloatArray
    motion_filter: CentreKalmanFilter


@dataclass(slots=True)
class Propagation:
    """Propagation of poses through a lost interval from all sides.

    Attributes:
        localiser: Estimates the pose of a frame near an expected one.
        interval: The interval.
        estimates: Poses found, by direction and frame.
    """

    localiser: GuidedLocaliser
    interval: LostInterval
    estimates: dict[tuple[int, int], PoseEstimate] = field(default_factory=dict)

    def run(self) -> dict[int, PoseEstimate]:
        """Return the best pose of each frame.

        Poses are propagated inwards from both ends and outwards from the seeds.
        """
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
            if estimate is None or not estimate.has_support(_SEED_MIN_INLIERS, _SEED_MIN_INLIER_WEIGHT_RATIO):
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
            if other is None or estimate.support > other.support:
                best[frame] = estimate
        return best

    def second_pass(
        self, estimates: Mapping[int, PoseEstimate], positions: Mapping[int, PositionEstimate]
    ) -> dict[int, PoseEstimate]:
        """Search again from the smoothed positions, also in a single frame missed between two others.

        Args:
            estimates: The result of `run`.
            positions: Smoothed positions of these frames and of those around them.
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
                estimate = max(estimates[frame], estimate or estimates[frame], key=lambda pose: pose.support)
            elif before is not None and after is not None:
                halfway = invert(interpolate_pose(invert(before), invert(after), 0.5))
                rotation = halfway[:3, :3]
                prior = make_transform(rotation, -rotation @ positions[frame].centre)
                estimate = self.localiser.localise(
                    search_frame, [prior], NeighbourPose(before), positions[frame]
                )
            if estimate is not None and estimate.has_support(_MIN_INLIERS, _MIN_INLIER_WEIGHT_RATIO):
                accepted[frame] = estimate
        return accepted

    def _initialised(self, end: int, direction: int) -> _PropagationState:
        """Return a state at the end of the interval, filtered over the frames with poses before it."""
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
        """Propagate frame by frame, until too many frames are missed or the interval ends."""
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
            fused, distance = (predicted, np.inf) if estimate is None else fuse(estimate.position, predicted)
            if (
                estimate is None
                or not estimate.has_support(_MIN_INLIERS, _MIN_INLIER_WEIGHT_RATIO)
                or distance >= _MAX_PREDICTION_DISTANCE
            ):
                misses += 1
                state.pose = priors[0]
                continue
            self.estimates[direction, frame] = estimate
            state.motion_filter.update(estimate.position)
            pose, _ = estimate.conditioned_on_centre(fused)
            state.rotation_step, state.pose, misses = pose[:3, :3] @ state.pose[:3, :3].T, pose, 0

    def _candidate_rotations(self, state: _PropagationState, frame: int) -> list[FloatArray]:
        """Return rotations (3,3) that the next frame may have.

        They are the one from the image motion, if that is known, and the one of a constant angular velocity.
        """
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
    """Return the pose before, else the pose after, else the frame's own pose.

    The frame's own pose stands for a camera that does not move.
    """
    if before is not None:
        return NeighbourPose(before)
    return NeighbourPose(pose) if after is None else NeighbourPose(after, -1)
