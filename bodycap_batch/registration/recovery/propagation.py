"""Propagate poses into a lost interval, frame by frame, from the frames with poses around it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.model.geometry import interpolate_pose, invert, make_transform, nearest_rotation
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
"""Minimum number of inliers and minimum inlier weight ratio of a pose that is found in a lost frame.
Evidence: none."""
_SEED_MIN_INLIERS, _SEED_MIN_INLIER_WEIGHT_RATIO = 15, 0.5
"""Minimum number of inliers and minimum inlier weight ratio of the pose of a seed (a keyframe inside the lost
interval). These minimums are higher than in other lost frames, because no predicted motion supports the pose.
Evidence: none."""
_MAX_PREDICTION_DISTANCE = 16.0
"""Maximum squared Mahalanobis distance between the found and the predicted centre. With a larger distance,
the found pose is rejected. Origin: about the 99.9 % quantile of the chi-squared distribution with three
degrees of freedom."""
_MAX_MISSES = 3
"""Maximum number of successive frames without a found pose. After one more such frame the propagation ends,
because the error of the prediction exceeds the search range. Evidence: none."""
_SEED_SIGMA_JERKS = 40.0
"""Sigma of a seed's centre along each axis, in units of the camera's jerk sigma. Evidence: none."""
_INITIAL_FRAMES = 6
"""Maximum number of frames that initialise the motion filter. They are the frames with poses next to the
interval, at the end from which the propagation starts. Evidence: none."""
_MAX_CORNERS, _CORNER_SPACING_PX, _GRID_SIDE = 48, 12.0, 4
"""_MAX_CORNERS: maximum number of corners for the image motion. _CORNER_SPACING_PX: minimum distance between
two corners, in pixels of the reduced image. _GRID_SIDE: number of points along each side of a grid; the
camera's rotation is fitted to the motion of these points. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LostInterval:
    """A lost interval and the frames around it.

    Attributes:
        start: First lost frame.
        stop: One past the last lost frame.
        times: (N,) times of all frames of the camera, in units of the frame interval.
        pyramids: Image pyramids by frame: of the frames to search, and of one frame on either side of the
            interval.
        poses: Poses of the camera's localised frames, by frame.
        tracked_frames: Indices of the frames with a pose from tracking.
        seed_poses: Poses cam_from_map (4,4) of the seeds, by frame. A seed is a keyframe in the interval
            whose pose was not accepted.
        keyframe_rows: Row indices of the seeds in the map, by frame.
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
        """Return a frame with its image pyramid, ready to be searched."""
        return SearchFrame(frame, self.pyramids[frame], self.keyframe_rows.get(frame, -1))


@dataclass(slots=True)
class _PropagationState:
    """State of a propagation after its last searched frame, used to predict the pose of the next frame.

    Attributes:
        frame: Index of the last frame.
        pose: (4,4) pose cam_from_map of the last frame.
        rotation_step: (3,3) rotation between the frame before and the last frame.
        motion_filter: Filter of the camera centre.
    """

    frame: int
    pose: FloatArray
    rotation_step: FloatArray
    motion_filter: CentreKalmanFilter


@dataclass(slots=True)
class Propagation:
    """Propagation of poses through a lost interval, from both ends and from the seeds in it.

    Attributes:
        localiser: Estimates the pose of a frame near an expected pose.
        interval: The lost interval.
        turns: Rotations (3,3) of the camera from one frame to another that were measured so far, by both
            frames; None for frames whose rotation cannot be measured. Several propagations share them.
        estimates: Found poses, by direction (1 forward, −1 backward) and frame.
    """

    localiser: GuidedLocaliser
    interval: LostInterval
    turns: dict[tuple[int, int], FloatArray | None] = field(default_factory=dict)
    estimates: dict[tuple[int, int], PoseEstimate] = field(default_factory=dict)

    def run(self) -> dict[int, PoseEstimate]:
        """Return the best pose found for each frame.

        Poses are propagated inward from both ends of the interval, and forward and backward from the seeds.
        The best pose of a frame is the pose with the highest support.
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
        """Search the frames again from the smoothed positions.

        A frame without a pose is also searched if both adjacent frames have a pose.

        Args:
            estimates: The result of `run`.
            positions: Smoothed positions of the interval's frames.

        Returns:
            Poses with enough support, by frame.
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

    def with_start_errors(self, estimates: Mapping[int, PoseEstimate]) -> dict[int, PoseEstimate]:
        """Return poses, by frame, with covariances that contain the errors of the starts of their searches.

        See `GuidedLocaliser.start_dependence`.
        """
        if not is_on(Mechanism.START_DEPENDENCE):
            return dict(estimates)
        record_act(Mechanism.START_DEPENDENCE, len(estimates))
        poses = {
            frame: estimate.cam_from_map for frame, estimate in {**self.interval.poses, **estimates}.items()
        }
        out = {}
        for frame, estimate in estimates.items():
            neighbour = _neighbour_pose(poses.get(frame - 1), poses.get(frame + 1), poses[frame])
            dependence = self.localiser.start_dependence(
                self.interval.search_frame(frame), estimate, neighbour
            )
            out[frame] = estimate.with_start_error(dependence)
        return out

    def _initialised(self, end: int, direction: int) -> _PropagationState:
        """Return the state from which a propagation starts at one end of the interval.

        The motion filter runs over the frames with poses before this end, in the given direction.
        """
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
        """Propagate the pose frame by frame in one direction (1 forward, −1 backward).

        The propagation ends in four cases: at the end of the interval, at a frame without an image pyramid,
        at a frame that already has a pose from this direction, or after more than `_MAX_MISSES` successive
        frames without a found pose.
        """
        interval, misses = self.interval, 0
        while misses <= _MAX_MISSES:
            frame = state.frame + direction
            inside = interval.start <= frame < interval.stop and frame in interval.pyramids
            if not inside or (direction, frame) in self.estimates:
                return
            predicted = state.motion_filter.predict(abs(interval.times[frame] - interval.times[state.frame]))
            # The step from the pose before doubles its deviation from a rotation each time: in fifty frames,
            # 1e-16 becomes 0.1.
            rotations = map(nearest_rotation, self._candidate_rotations(state, frame))
            priors = [make_transform(rotation, -rotation @ predicted.centre) for rotation in rotations]
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
        """Return possible rotations cam_from_map (3,3) of the next frame, the most likely first.

        The first candidate follows from matches between adjacent frames or from the image motion, if one of
        them is known. The last candidate assumes a constant angular velocity.
        """
        rotation = state.pose[:3, :3]
        previous_pyramid, pyramid = self.interval.pyramids.get(state.frame), self.interval.pyramids[frame]
        constant_rotation = [state.rotation_step @ rotation]
        shutter = self.localiser.shutter
        matched = None if shutter is None else shutter.path.turn(state.frame, frame)
        if matched is not None:
            return [matched @ rotation, *constant_rotation]
        if previous_pyramid is None:
            return constant_rotation
        frames = state.frame, frame
        if frames not in self.turns:
            self.turns[frames] = self._turn_of_pictures(previous_pyramid, pyramid)
        turn = self.turns[frames]
        return constant_rotation if turn is None else [turn @ rotation, *constant_rotation]

    def _turn_of_pictures(self, first: Pyramid, second: Pyramid) -> FloatArray | None:
        """Return the rotation (3,3) of the camera from one frame to another, from the motion of the picture.

        None is returned if the motion is unknown, or if it moves too much of the picture out of sight.
        """
        lens = self.localiser.lens
        before, after = make_coarse_image(first.levels[0]), make_coarse_image(second.levels[0])
        width = lens.width_px
        corners = detect_corners(before, _MAX_CORNERS, _CORNER_SPACING_PX)
        motion = estimate_coarse_motion(before, after, corners * np.float32(width / before.shape[1]), width)
        if motion is None:
            return None
        fractions = np.linspace(0.2, 0.8, _GRID_SIDE)
        grid = np.stack(np.meshgrid(fractions * width, fractions * lens.height_px), axis=-1).reshape(-1, 2)
        arrived = apply_homography(grid.astype(np.float32), motion.homography).astype(np.float64)
        inside = ((arrived > 0.0) & (arrived < (width, lens.height_px))).all(axis=1)
        if inside.sum() < _GRID_SIDE:
            return None
        start, end = (unit_directions(lens.unproject(px[inside])) for px in (grid, arrived))
        return fit_rotation(start, end)


def _neighbour_pose(before: FloatArray | None, after: FloatArray | None, pose: FloatArray) -> NeighbourPose:
    """Return the pose of the frame before, or the pose of the frame after if there is none before.

    If both are missing, the frame's own pose is returned. The camera is then treated as stationary.

    Args:
        before: (4,4) pose cam_from_map of the frame before, or None.
        after: (4,4) pose cam_from_map of the frame after, or None.
        pose: (4,4) pose cam_from_map of the frame.
    """
    if before is not None:
        return NeighbourPose(before)
    return NeighbourPose(pose) if after is None else NeighbourPose(after, -1)
