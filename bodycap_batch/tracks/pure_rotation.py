"""Measure how a camera that hardly moves turns through its video.

If a camera moves by a hundredth of the distance to the room, its positions are lost in the noise, and so are
maps: their points have no angle between rays. Its rotation is still known. All points of the room are taken
to be so far away that only the turn of the camera moves them. The directions of the points and the rotations
of all frames are solved together.

What the missing translation does to the rotation is measured: by a second solution with a room at one
distance, and by solutions from the quarters of the picture. Hands and carried things that the robust weights
leave in one quarter show in the others' disagreement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import nearest_rotation, rotation_angle_rad, skew, so3_exp
from bodycap_batch.model.optical_flow import pixel_scale, unit_directions
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory

_GRID = (12, 9)
"""Number of columns and rows of the cells of the picture. Each cell counts the same, so that a textured hand
does not outvote a plain room."""
_FIRST_SCALE_PX = 8.0
"""Residual, px of an image with a long side of 640 px, at which the weight of a point falls to a quarter in
the first iteration: hands and carried things are then not followed. Evidence: docs/decisions/tracks.md."""
_LAST_SCALE_PX = 1.5
"""The same at the end: five times the noise of a track. Evidence: docs/decisions/tracks.md."""
_SCALE_FALL = 0.85
"""Ratio of the scales of successive iterations (graduated non-convexity). Evidence:
docs/decisions/tracks.md."""
_ITERATIONS = 40
"""Number of iterations of a solution. Evidence: docs/decisions/tracks.md."""
_REFINEMENTS = 15
"""Number of iterations of a solution that starts from another one. Evidence: none."""
_TURN_ITERATIONS = 12
"""Number of iterations for the turn between two frames: the last one has the last scale."""
_INLIER_PX = 3.0
"""Maximum residual of a point that follows the turn, px of an image with a long side of 640 px: twice the
last scale."""
_MIN_SUPPORT = 0.5
"""Minimum share of the cells of a frame that follow the turn: then the room is most of the picture. Evidence:
docs/decisions/tracks.md."""
_MIN_FRAMES = 0.9
"""Minimum share of the frames in which this is so. With less, the camera moves. Evidence: none."""
_MIN_POINTS = 12
"""Minimum number of points of a frame, and of points that two successive frames have in common, as for the
rotation between two frames."""
_MIN_CELLS = 8.0
"""Minimum number of cells that follow the turn: a twelfth of the picture, as for the rotation between two
frames."""
_MAX_SIGMA_RAD = float(np.deg2rad(5.0))
"""Maximum standard deviation of the rotations per axis, as for the rotation between two frames."""
_LEVER_SIGMA = 0.15
"""Standard deviation of the turned angles, as a share: a head turns about a neck some 10 cm behind the
camera, and a table is 0.7 m away. No picture of a flat table tells this motion from a turn. Evidence:
docs/decisions/tracks.md."""
_ROOM_SIGMA = 0.3
"""Standard deviation of the camera's position in the second solution, as a share of the distance to the room.
It only keeps frames with few points from leaving the room."""
_NOISE_PX = 0.6
"""Standard deviation of a track in the second solution, px of an image with a long side of 640 px."""
_MAX_OBSERVATIONS = 1_000_000
"""Maximum number of observations, so that ten minutes need no more than some 300 MB: 55 points a frame."""
_CHUNK = 1 << 16
"""Number of observations whose derivatives are in memory at the same time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PureRotation:
    """The rotations of a camera that hardly moves.

    Attributes:
        first_from_cam: (N,3,3) rotation of each frame in the axes of the first measured one; NaN for a frame
            that does not show it.
        sigma_rad: (N,) standard deviation of each rotation per axis.
    """

    first_from_cam: FloatArray
    sigma_rad: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "first_from_cam", (None, 3, 3), finite=False)
        set_array(self, "sigma_rad", (len(self.first_from_cam),), finite=False)

    @property
    def measured(self) -> BoolArray:
        """Mask (N,) of the frames with a rotation."""
        return np.asarray(np.isfinite(self.first_from_cam).all(axis=(1, 2)))


def measure_pure_rotation(tracks: PointTracks, lens: Camera, lens_sigma: float = 0.0) -> PureRotation | None:
    """Measure the rotations of a camera that hardly moves.

    Args:
        tracks: Tracks of points in the room, in all frames.
        lens: Intrinsics of the camera at the size of the tracks.
        lens_sigma: Relative standard deviation of the focal length.

    Returns:
        None if a pure rotation does not explain what most of the video shows: the camera moves. None, too, if
        the rotations are too uncertain.
    """
    problem = _Problem.create(tracks, lens)
    usable = np.flatnonzero(problem.counts >= _MIN_POINTS)
    if len(usable) < 2:
        return None
    turn, residual_px = problem.solve()
    share, cells = problem.support(residual_px)
    shown = (share >= _MIN_SUPPORT) & (cells >= _MIN_CELLS)
    shown &= problem.linked(residual_px, np.flatnonzero(shown))
    if shown.sum() < max(2.0, _MIN_FRAMES * len(shown)):
        return None
    moving, _ = problem.solve(turn, with_translation=True)
    deviations = [_deviation(moving, turn, shown)]
    quarters = []
    for number in range(4):
        part = problem.only(problem.quarter == number)
        known = shown & (part.counts >= _MIN_POINTS)
        if known.any():
            quarters.append(np.where(known, _deviation(part.solve(turn)[0], turn, known), np.nan))
    if len(quarters) < 2:
        return None
    squares = np.array(quarters) ** 2
    count = np.isfinite(squares).sum(axis=0)
    # The variance of the mean of the quarters: their own is that of one quarter.
    deviations.append(np.sqrt(np.nansum(squares, axis=0) / np.maximum(count * (count - 1), 1)))
    # The error of a single frame is not known: these deviations show that of all frames.
    variance = np.sum(np.square(deviations), axis=0)[shown].mean()
    # A wrong focal length, and a camera before the joint about which it turns, change all angles by a ratio.
    angle = _deviation(np.broadcast_to(np.eye(3), turn.shape), turn, shown)
    sigma_rad = np.sqrt((variance + (lens_sigma**2 + _LEVER_SIGMA**2) * angle**2) / 3.0)
    if np.sqrt((sigma_rad[shown] ** 2).mean()) > _MAX_SIGMA_RAD:
        return None
    first = turn[np.argmax(shown)]
    rotations = np.where(shown[:, None, None], first.T @ turn, np.nan)
    return PureRotation(first_from_cam=rotations, sigma_rad=np.where(shown, sigma_rad, np.nan))


def rotations_alone(path: Trajectory, turn: PureRotation, scene: Map | None) -> Trajectory:
    """Return a path with the rotations of a camera that hardly moves, and without positions.

    A damaged or frozen frame stays one: its picture is not of its time.

    Args:
        path: The path, with positions that say nothing or without any.
        turn: The rotations of the same N frames.
        scene: The map of the path, in whose axes the rotations are given as far as its keyframes show them.
            An empty map has the axes of the first measured frame. None if no map contains the camera.
    """
    no_picture = (FrameStatus.DAMAGED, FrameStatus.FROZEN)
    shown = turn.measured & np.array([each not in no_picture for each in path.status], dtype=bool)
    known = path.gauge_from_cam[:, :3, :3].copy()
    if scene is not None and not path.localised.any():
        own = scene.keyframes_of(path.camera)
        known[scene.keyframe_frame[own]] = scene.map_from_cam[own, :3, :3]
    both = turn.measured & np.isfinite(known).all(axis=(1, 2))
    sums = np.sum(known[both] @ np.swapaxes(turn.first_from_cam[both], 1, 2), axis=0)
    gauge_from_first = nearest_rotation(sums) if both.any() else np.eye(3)
    poses = np.full((len(path.status), 4, 4), np.nan)
    poses[shown] = np.eye(4)
    poses[shown, :3, 3] = np.nan
    poses[shown, :3, :3] = gauge_from_first @ turn.first_from_cam[shown]
    covariance = np.full((len(poses), 6, 6), np.nan)
    covariance[shown, :3, :3] = turn.sigma_rad[shown, None, None] ** 2 * np.eye(3)
    had_position = path.localised | np.array([each is FrameStatus.OTHER_MAP for each in path.status])
    lost = np.where(had_position, FrameStatus.UNCONSTRAINED, path.status)
    return replace(
        path,
        gauge=path.gauge if scene is None else scene.gauge,
        gauge_from_cam=poses,
        covariance=covariance,
        status=tuple(map(FrameStatus, np.where(shown, FrameStatus.ROTATION_ONLY, lost))),
        inliers=np.zeros_like(path.inliers),
        error_px=np.full_like(path.error_px, np.nan),
    )


def _deviation(rotations: FloatArray, others: FloatArray, known: BoolArray) -> FloatArray:
    """Return the angles (N,) between rotations (N,3,3), after the best common turn of the known frames."""
    mean = nearest_rotation(np.sum(others[known] @ np.swapaxes(rotations[known], 1, 2), axis=0))
    return rotation_angle_rad(np.swapaxes(mean @ rotations, 1, 2) @ others)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """M observations of T points in N frames.

    Attributes:
        rays: (M,3) unit lines of sight in the axes of the camera.
        frame: (M,) their frames, increasing.
        point: (M,) their points.
        cell: (M,) cell of the picture of each.
        quarter: (M,) quarter of the picture of each.
        px_rad: Angle of one px of an image with a long side of 640 px.
        counts: (N,) number of observations of each frame.
        point_count: Number T of points.
        share: (M,) share of its cell that an observation stands for.
    """

    rays: FloatArray
    frame: IntArray
    point: IntArray
    cell: IntArray
    quarter: IntArray
    px_rad: float
    counts: IntArray
    point_count: int
    share: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        keys = self.frame * (_GRID[0] * _GRID[1]) + self.cell
        _, group, size = np.unique(keys, return_inverse=True, return_counts=True)
        object.__setattr__(self, "share", 1.0 / size[group])

    @staticmethod
    def create(tracks: PointTracks, lens: Camera) -> _Problem:
        rays = unit_directions(lens.unproject(tracks.px.astype(np.float64)))
        # What one frame alone shows says nothing. Of a long video, a part of the tracks is enough.
        kept = np.bincount(tracks.track) > 1
        kept[np.arange(len(kept)) % -(-len(rays) // _MAX_OBSERVATIONS) > 0] = False
        seen = np.isfinite(rays).all(axis=1) & kept[tracks.track]
        frame = np.repeat(np.arange(tracks.frame_count), np.diff(tracks.first))
        place = tracks.px / (tracks.width_px, tracks.height_px)
        column, row = np.clip((place * _GRID).astype(np.int64), 0, np.array(_GRID) - 1).T
        right, below = (place > 0.5).astype(np.int64).T
        return _Problem(
            rays=rays[seen],
            frame=frame[seen],
            point=tracks.track[seen],
            cell=(row * _GRID[0] + column)[seen],
            quarter=(2 * below + right)[seen],
            px_rad=pixel_scale(tracks.width_px, tracks.height_px) / lens.focal_px,
            counts=np.bincount(frame[seen], minlength=tracks.frame_count),
            point_count=1 + int(tracks.track.max(initial=-1)),
        )

    def only(self, chosen: BoolArray) -> _Problem:
        """Return the problem with some of the observations (M,)."""
        return replace(
            self,
            rays=self.rays[chosen],
            frame=self.frame[chosen],
            point=self.point[chosen],
            cell=self.cell[chosen],
            quarter=self.quarter[chosen],
            counts=np.bincount(self.frame[chosen], minlength=len(self.counts)),
        )

    def solve(
        self, start: FloatArray | None = None, *, with_translation: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Solve the rotations and the directions of the points in turn, by reweighted least squares.

        Args:
            start: (N,3,3) rotations of another solution; None to start with the sum of the turns between
                successive frames.
            with_translation: Also solve positions, in a room at distance 1 in all directions.

        Returns:
            The rotations (N,3,3), in arbitrary axes, and the residuals (M,), px of 640.
        """
        rotations = self._chained() if start is None else start
        centres = np.zeros((len(rotations), 3))
        weights = np.ones(len(self.rays))
        residual_px = weights
        for scale_px in _scales_px(_ITERATIONS) if start is None else [_LAST_SCALE_PX] * _REFINEMENTS:
            world = np.einsum("mij,mj->mi", rotations[self.frame], self.rays)
            seen_from = centres[self.frame]
            sums = self._per_point((world + seen_from) * weights[:, None])
            points = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
            towards = points[self.point]
            if with_translation:
                towards = towards - seen_from
                towards /= np.linalg.norm(towards, axis=1, keepdims=True)
            residual_px = np.linalg.norm(world - towards, axis=1) / self.px_rad
            weights = 1.0 / (1.0 + (residual_px / scale_px) ** 2) ** 2
            if with_translation:
                turn, step = self._frame_steps(world, towards, centres, weights * self.share)
                rotations, centres = so3_exp(turn) @ rotations, centres + step
            else:
                rotations = self._frame_rotations(towards, rotations, weights * self.share)
        return rotations, residual_px

    def support(self, residual_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how much of the area with points follows the turn in each frame: share (N,), cells (N,)."""
        weights = self.share * (residual_px <= _INLIER_PX)
        follow = np.bincount(self.frame, weights, minlength=len(self.counts))
        area = np.bincount(self.frame, self.share, minlength=len(self.counts))
        return np.asarray(follow / np.maximum(area, 1e-12)), np.asarray(follow, dtype=np.float64)

    def linked(self, residual_px: FloatArray, frames: IntArray) -> BoolArray:
        """Return which of some frames form the longest part with enough points from each frame to the next.

        Across a cut or a dark picture, nothing relates the rotations.
        """
        follows = residual_px <= _INLIER_PX
        points = [self.point[self._rows(frame)][follows[self._rows(frame)]] for frame in frames.tolist()]
        shared = [len(np.intersect1d(*pair, assume_unique=True)) for pair in pairwise(points)]
        breaks = [number + 1 for number, count in enumerate(shared) if count < _MIN_POINTS]
        parts = [frames[first:last] for first, last in pairwise([0, *breaks, len(frames)])]
        return np.isin(np.arange(len(self.counts)), max(parts, key=len))

    def _rows(self, frame: int) -> slice:
        """Return the observations of a frame."""
        return slice(int(np.searchsorted(self.frame, frame)), int(np.searchsorted(self.frame, frame + 1)))

    def _per_point(self, values: FloatArray) -> FloatArray:
        """Return the sums (T,K) of values (M,K) over the observations of each point."""
        return _sums(self.point, values, self.point_count)

    def _chained(self) -> FloatArray:
        """Return rotations (N,3,3) as the sum of the robust turns between successive frames."""
        rotation, out, last = np.eye(3), np.tile(np.eye(3), (len(self.counts), 1, 1)), -1
        for frame in np.flatnonzero(self.counts).tolist():
            if last >= 0:
                before, now = self._rows(last), self._rows(frame)
                _, rows, other_rows = np.intersect1d(
                    self.point[before], self.point[now], assume_unique=True, return_indices=True
                )
                old, new = self.rays[before][rows], self.rays[now][other_rows]
                rotation = rotation @ self._turn(old, new, self.share[before][rows])
            out[frame], last = rotation, frame
        return out

    def _turn(self, old: FloatArray, new: FloatArray, share: FloatArray) -> FloatArray:
        """Return the rotation (3,3) with old = rotation · new for most of the area."""
        rotation = np.eye(3)
        if len(old) < 2:
            return rotation
        weights = np.ones(len(old))
        for scale_px in _scales_px(_TURN_ITERATIONS):
            rotation = nearest_rotation((old * (weights * share)[:, None]).T @ new)
            residual_px = np.linalg.norm(new @ rotation.T - old, axis=1) / self.px_rad
            weights = 1.0 / (1.0 + (residual_px / scale_px) ** 2) ** 2
        return rotation

    def _frame_rotations(self, towards: FloatArray, rotations: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the rotations (N,3,3) that turn the lines of sight to the directions (M,3) of the points."""
        products = (weights[:, None, None] * towards[:, :, None] * self.rays[:, None, :]).reshape(-1, 9)
        sums = _sums(self.frame, products, len(rotations)).reshape(-1, 3, 3)
        return np.where((self.counts >= 2)[:, None, None], nearest_rotation(sums), rotations)

    def _frame_steps(
        self, world: FloatArray, towards: FloatArray, centres: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the steps (N,3) of the rotation vectors and of the positions of all frames."""
        noise = (_NOISE_PX * self.px_rad) ** 2
        normal, gradient = np.zeros((len(centres), 36)), np.zeros((len(centres), 6))
        for rows in _chunks(len(world)):
            near = towards[rows]
            across = np.eye(3) - near[:, :, None] * near[:, None, :]
            jacobian = np.concatenate([-skew(world[rows]), across], axis=2)
            weighted = jacobian * (weights[rows] / noise)[:, None, None]
            squares = np.einsum("mij,mik->mjk", weighted, jacobian).reshape(-1, 36)
            normal += _sums(self.frame[rows], squares, len(centres))
            pulled = np.einsum("mij,mi->mj", weighted, world[rows] - near)
            gradient += _sums(self.frame[rows], pulled, len(centres))
        system = normal.reshape(-1, 6, 6)
        system[:, range(6), range(6)] += [1.0] * 3 + [_ROOM_SIGMA**-2] * 3
        gradient[:, 3:] += centres / _ROOM_SIGMA**2
        step = -np.linalg.solve(system, gradient[..., None])[..., 0]
        return np.asarray(step[:, :3]), np.asarray(step[:, 3:])


def _sums(group: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return the sums (count,K) of values (M,K) over the rows of each group (M,)."""
    return np.column_stack([np.bincount(group, column, minlength=count) for column in values.T])


def _scales_px(count: int) -> list[float]:
    """Return the scale of the robust weights in each iteration."""
    return [max(_LAST_SCALE_PX, _FIRST_SCALE_PX * _SCALE_FALL**number) for number in range(count)]


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, start + _CHUNK)
