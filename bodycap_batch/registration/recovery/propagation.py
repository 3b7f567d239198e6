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
    known: Mapping[int, PoseEstimate]
    tracked: Collection[int]
    seeds: Mapping[int, FloatArray]
    rows: Mapping[int, int]
    steadiness: MotionStatistics

    def seen(self, frame: int) -> SearchFrame:
        """A frame of which the picture is held."""
        return SearchFrame(self.pyramids[frame], self.rows.get(frame, -1))


@dataclass(slots=True)
class _PropagationState:
    """Where a walk has come to: the last frame, its pose and its turn from the one before."""

    frame: int
    pose: FloatArray
    turn: FloatArray
    path: CentreKalmanFilter


@dataclass(slots=True)
class Propagation:
    """Walks through a stretch from all sides.

    Attributes:
        finder: Finds poses.
        stretch: The stretch.
        fixes: What was found, by direction and frame.
    """

    finder: GuidedLocaliser
    stretch: LostInterval
    fixes: dict[tuple[int, int], PoseEstimate] = field(default_factory=dict)

    def run(self) -> dict[int, PoseEstimate]:
        """The best pose found for each frame, walking in from both ends and out from the seeds."""
        stretch = self.stretch
        for direction, end in ((1, stretch.start - 1), (-1, stretch.stop)):
            if end in stretch.known:
                self._walk(self._warmed_up(end, direction), direction)
        for frame, prior in sorted(stretch.seeds.items()):
            if (1, frame) in self.fixes or (-1, frame) in self.fixes or frame not in stretch.pyramids:
                continue
            spread = np.eye(3) * (_SEED_SIGMA_JERKS * stretch.steadiness.jerk) ** 2
            expected = PositionEstimate(invert(prior)[:3, 3], spread)
            fix = self.finder.locate(stretch.seen(frame), [prior], NeighbourPose(prior), expected)
            if fix is None or fix.inliers < _SEED_MIN_INLIERS or fix.evidence < _SEED_MIN_INLIER_WEIGHT_RATIO:
                continue
            for direction in (1, -1):
                self.fixes[direction, frame] = fix
                path = CentreKalmanFilter(stretch.steadiness, fix.place)
                self._walk(_PropagationState(frame, fix.cam_from_map, np.eye(3), path), direction)
        best: dict[int, PoseEstimate] = {}
        for (_, frame), fix in sorted(self.fixes.items()):
            other = best.get(frame)
            if other is None or fix.inliers * fix.evidence > other.inliers * other.evidence:
                best[frame] = fix
        return best

    def again(
        self, fixes: Mapping[int, PoseEstimate], places: Mapping[int, PositionEstimate]
    ) -> dict[int, PoseEstimate]:
        """Look once more from smoothed places, and between two frames of which one was missed.

        Args:
            fixes: What `run` found.
            places: Smoothed places of these frames and those around them.
        """
        out = {}
        poses = {frame: fix.with_place(places[frame])[0] for frame, fix in fixes.items()}
        poses |= {frame: fix.cam_from_map for frame, fix in self.stretch.known.items()}
        for frame in range(self.stretch.start, self.stretch.stop):
            before, after = poses.get(frame - 1), poses.get(frame + 1)
            fix: PoseEstimate | None = None
            if frame not in self.stretch.pyramids:
                continue
            seen = self.stretch.seen(frame)
            if frame in fixes:
                fix = self.finder.look_again(seen, poses[frame], _neighbour_pose(before, after, poses[frame]))
                fix = max(fixes[frame], fix or fixes[frame], key=lambda each: each.inliers * each.evidence)
            elif before is not None and after is not None:
                halfway = invert(interpolate_pose(invert(before), invert(after), 0.5))
                turn = halfway[:3, :3]
                prior = make_transform(turn, -turn @ places[frame].centre)
                fix = self.finder.locate(seen, [prior], NeighbourPose(before), places[frame])
            if fix is not None and fix.inliers >= _MIN_INLIERS and fix.evidence >= _MIN_INLIER_WEIGHT_RATIO:
                out[frame] = fix
        return out

    def _warmed_up(self, end: int, direction: int) -> _PropagationState:
        """A walk that has come through the frames with poses up to an end of the stretch."""
        known = self.stretch.known
        behind = [end - direction * number for number in range(_INITIAL_FRAMES)]
        gap = next((number for number, frame in enumerate(behind) if frame not in known), _INITIAL_FRAMES)
        frames = behind[:gap][::-1]
        path = CentreKalmanFilter(self.stretch.steadiness, known[frames[0]].place)
        for last, frame in pairwise(frames):
            path.predict(abs(self.stretch.times[frame] - self.stretch.times[last]))
            path.update(known[frame].place)
        turns = [known[frame].cam_from_map[:3, :3] for frame in frames[-2:]]
        turn = turns[1] @ turns[0].T if len(turns) == 2 else np.eye(3)
        return _PropagationState(end, known[end].cam_from_map, turn, path)

    def _walk(self, walk: _PropagationState, direction: int) -> None:
        stretch, misses = self.stretch, 0
        while misses <= _MAX_MISSES:
            frame = walk.frame + direction
            inside = stretch.start <= frame < stretch.stop and frame in stretch.pyramids
            if not inside or (direction, frame) in self.fixes:
                return
            place = walk.path.predict(abs(stretch.times[frame] - stretch.times[walk.frame]))
            priors = [make_transform(turn, -turn @ place.centre) for turn in self._turns(walk, frame)]
            beside = NeighbourPose(walk.pose, direction)
            fix = self.finder.locate(stretch.seen(frame), priors, beside, place)
            walk.frame = frame
            good = (
                fix is not None and fix.inliers >= _MIN_INLIERS and fix.evidence >= _MIN_INLIER_WEIGHT_RATIO
            )
            both, distance = (place, np.inf) if fix is None else fuse(fix.place, place)
            if fix is None or not good or distance >= _MAX_PREDICTION_DISTANCE:
                misses += 1
                walk.pose = priors[0]
                continue
            self.fixes[direction, frame] = fix
            walk.path.update(fix.place)
            pose, _ = fix.with_place(both)
            walk.turn, walk.pose, misses = pose[:3, :3] @ walk.pose[:3, :3].T, pose, 0

    def _turns(self, walk: _PropagationState, frame: int) -> list[FloatArray]:
        """Rotations (3,3) the next frame may have: as the image turned, and as the camera turned before."""
        here, lens = walk.pose[:3, :3], self.finder.lens
        last, this = self.stretch.pyramids.get(walk.frame), self.stretch.pyramids[frame]
        steady = [walk.turn @ here]
        if last is None:
            return steady
        first, second = make_coarse_image(last.levels[0]), make_coarse_image(this.levels[0])
        width = lens.width_px
        corners = detect_corners(first, _MAX_CORNERS, _CORNER_SPACING_PX)
        motion = estimate_coarse_motion(first, second, corners * np.float32(width / first.shape[1]), width)
        if motion is None:
            return steady
        shares = np.linspace(0.2, 0.8, _GRID_SIDE)
        grid = np.stack(np.meshgrid(shares * width, shares * lens.height_px), axis=-1).reshape(-1, 2)
        arrived = apply_homography(grid.astype(np.float32), motion.homography).astype(np.float64)
        inside = ((arrived > 0.0) & (arrived < (width, lens.height_px))).all(axis=1)
        if inside.sum() < _GRID_SIDE:
            return steady
        before, after = (unit_directions(lens.unproject(each[inside])) for each in (grid, arrived))
        return [fit_rotation(before, after) @ here, *steady]


def _neighbour_pose(before: FloatArray | None, after: FloatArray | None, own: FloatArray) -> NeighbourPose:
    """The frame before, else the one after, else one as if the camera stood."""
    if before is not None:
        return NeighbourPose(before)
    return NeighbourPose(own) if after is None else NeighbourPose(after, -1)
