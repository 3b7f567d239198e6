"""The rotation of a camera over time, and the correction of rolling shutters by it.

A camera with a rolling shutter exposes each row of an image at another instant. If the orientation of the
camera is known as a function of time, each observed pixel can be moved to the place where it would be if the
whole image were exposed together with its middle row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.gyro_rates import GyroRates
from bodycap_batch.model.optical_flow import pixel_scale, unit_directions
from bodycap_batch.model.rolling_shutter import row_delay

_RATE_SIGMA = 2.0
"""Largest expected error of an angular velocity from the spline, rad/s, along each axis. Evidence: none."""
_MIN_RATE_SIGMA = 0.01
"""Smallest expected error of an angular velocity from the spline, rad/s. Evidence: none."""
_RATE_FITS = 3
"""Number of times that the weights and the prior of the angular velocities are computed again. Evidence:
none."""
_RATE_NOISE_PX = 0.7
"""Standard deviation of an observation, px of an image with a long side of 640 px. Evidence: none."""
_MAX_RATE_RESIDUAL_PX = 12.0
"""Maximum residual of an observation that is used for an angular velocity, px of an image with a long side of
640 px. Evidence: none."""
_MIN_RATE_POINTS = 15
"""Minimum number of observations of a frame for its angular velocity. Origin: 30 measured coordinates for 9
unknowns. Evidence: none."""
_RATE_BATCH_FRAMES = 64
"""Number of frames whose equations are made together. It bounds the memory."""
_NOISE_FROM_QUARTILE = 1.57
"""Ratio of the root mean square length of a normally distributed vector in three dimensions to the first
quartile of its length: sqrt(3 / 1.213). The first quartile of the squared length is 1.213 variances."""
_END_RATE_SIGMA = 0.2
"""Expected error of the angular velocity of a frame at the end of a run of poses, rad/s. Evidence:
docs/decisions/registration.md."""
_END_RATE_SIGMA_RATIO = 0.4
"""The same error as a ratio of this velocity. Both are added. Evidence: docs/decisions/registration.md."""
_MIN_LOOSE_POINTS = 60
"""Minimum number of observations of a frame for the larger expected error, at the end of a run of poses and
where the velocity deviates from its neighbours. Evidence: none."""
_RATE_DEVIATION_RATIO = 0.3
"""Expected error of the angular velocity of a frame, as a ratio of its deviation from both neighbours.
Evidence: docs/decisions/registration.md."""
_ACCELERATION_DEVIATION_RATIO = 1.0
"""Expected change of the angular velocity in one frame interval that the cubic does not contain, as a ratio
of the same deviation. Evidence: docs/decisions/registration.md."""
_VELOCITY_DEVIATION_RATIO = 0.3
"""Expected error of the velocity of a frame, as a ratio of its deviation from both neighbours. Origin: the
same ratio as for angular velocities."""
_MIN_SPEED_SIGMA_RATIO = 0.01
"""Smallest expected error of a velocity, as a ratio of the largest usual speed of the camera. Evidence:
none."""
_SPEED_PERCENTILE = 90.0
"""Percentile of the speeds of a camera from which its largest plausible speed is computed. Evidence: none."""
_MAX_SPEED_RATIO = 2.0
"""Ratio of the largest plausible speed of a camera to the percentile of its speeds. Faster steps are errors
of poses. Evidence: docs/decisions/registration.md."""
_EXTRAPOLATION_RATIO = 0.5
"""Expected error of an extrapolated angular velocity, as a ratio of the largest velocity around the frame.
Evidence: docs/decisions/registration.md."""
_RATE_TOLERANCE = 1e-4
"""Relative change of the angular velocities of a smoothest path at which its computation ends. It takes half
the time of the default, 1e-9. Origin: it changes the velocities of a simulated path of 90 frames by
less than 0.0001 rad/s. Their expected error is at least 0.1 rad/s (`rotation_fit`)."""
_ROW_ROUNDS = 4
"""Number of times that the row in which a point is exposed is computed again. Origin: a camera that turns by
50 degrees a frame moves a point by the height of a picture in one frame interval; with a readout of half an
interval, each round at least halves the error."""
_MAX_GAP_FRAMES = 3.0
"""Maximum time between two adjacent frames of one segment of the path, in median frame intervals. Over a
longer time, the rotation between the frames is not smooth enough. Evidence:
docs/decisions/registration.md (velocities over a hole of one second)."""


@dataclass(frozen=True, slots=True)
class RotationPath:
    """The orientation of a camera over time: orientation and angular rate of each frame, and a cubic between.

    Where the rotation between two adjacent frames is unknown, a new segment begins. Orientations of different
    segments cannot be compared.

    Attributes:
        times_ns: (N,) frame times, nanoseconds.
        rotation: (N,3,3) orientation of each frame: segment_from_cam.
        segment: (N,) number of the segment of each frame, not decreasing.
        rate: (N,3) angular velocity at the time of each frame, in the camera frame, rad/s.
        gyro: What the gyroscope of the camera measured; None if there is none. Near a frame time that its
            samples cover, it replaces the cubic.
        acceleration: (N,3) angular acceleration around the time of each frame that is not contained in the
            cubic, in the camera frame, rad/s²; None if there is none.
    """

    times_ns: IntArray
    rotation: FloatArray
    segment: IntArray
    rate: FloatArray
    gyro: GyroRates | None = None
    acceleration: FloatArray | None = None

    @staticmethod
    def from_steps(
        times_ns: IntArray,
        step: FloatArray,
        known: BoolArray,
        rate: FloatArray | None = None,
        *,
        shrunk: bool = True,
    ) -> RotationPath:
        """Return the path with given rotations between adjacent frames.

        Args:
            times_ns: (N,) frame times, nanoseconds.
            step: (N-1,3,3) rotation later_from_earlier of each frame and the next frame.
            known: (N-1,) True if the rotation is known.
            rate: (N,3) angular velocity of each frame, in the camera frame, rad/s. None: the velocity of the
                smoothest path through the orientations; zero for a frame that is alone in its segment.
            shrunk: True to shrink the velocity of the smoothest path towards a mean velocity where it differs
                by noise. That is more exact for each frame, but the velocities are too small on average.
        """
        segment = np.concatenate([[0], np.cumsum(~(known & near_in_time(times_ns)))])[: len(times_ns)]
        rotation = np.tile(np.eye(3), (len(times_ns), 1, 1))
        for later in np.flatnonzero(np.diff(segment) == 0) + 1:
            rotation[later] = rotation[later - 1] @ step[later - 1].T
        if rate is None:
            rate = _spline_rates(times_ns, rotation, segment)
            if shrunk:
                rate = _without_noise(rate, _mean_rates(times_ns, rotation, segment))
        return RotationPath(times_ns, rotation, segment, rate)

    @staticmethod
    def from_gyro(times_ns: IntArray, gyro: GyroRates, other: RotationPath | None = None) -> RotationPath:
        """Return the path that a gyroscope measured.

        Args:
            times_ns: (N,) frame times, nanoseconds.
            gyro: The measured angular velocities.
            other: The path where the gyroscope has no samples; None if it is unknown there.
        """
        step, known, rate = gyro.at_frames(times_ns)
        if other is not None:
            other_step, other_known = other.steps()
            step = np.where(known[:, None, None], step, other_step)
            rate = np.where(_covered(times_ns, gyro)[:, None], rate, other.rate)
            known = known | other_known
        return replace(RotationPath.from_steps(times_ns, step, known, rate), gyro=gyro)

    def measured(self) -> BoolArray:
        """Return a mask (N,) of the frames at whose times the gyroscope has samples."""
        if self.gyro is None:
            return np.zeros(len(self.times_ns), dtype=bool)
        return _covered(self.times_ns, self.gyro)

    def steps(self) -> tuple[FloatArray, BoolArray]:
        """Return the rotations (N-1,3,3) between adjacent frames, and a mask (N-1,) of the known ones."""
        step = np.swapaxes(self.rotation[1:], 1, 2) @ self.rotation[:-1]
        return step, np.asarray(np.diff(self.segment) == 0)

    def with_poses(self, map_from_cam: FloatArray, *, shrunk: bool = True) -> RotationPath:
        """Return the path in which poses replace the rotations between those adjacent frames that have poses.

        Args:
            map_from_cam: (N,4,4) poses of the frames; NaN for a frame without a pose.
            shrunk: The same as for `from_steps`.
        """
        step, known = self.steps()
        has_pose = np.asarray(np.isfinite(map_from_cam).all(axis=(1, 2)))
        both = has_pose[1:] & has_pose[:-1]
        if not both.any():
            return self
        rotation = map_from_cam[:, :3, :3]
        step[both] = np.swapaxes(rotation[1:], 1, 2)[both] @ rotation[:-1][both]
        posed = RotationPath.from_steps(self.times_ns, step, known | both, shrunk=shrunk)
        # Without a neighbour with a pose on each side, poses determine the rate no better than matches.
        beside = np.concatenate([[False], both]) & np.concatenate([both, [False]]) & ~self.measured()
        rate = np.where(beside[:, None], posed.rate, self._rate_or(posed.rate))
        # Without matches, the rate at an end is that between its neighbours. The pose of the frame itself
        # depends on its rate: together they drift away.
        at_end = np.flatnonzero(has_pose & ~beside & ~self.measured() & self.is_alone())
        mean = so3_log(np.swapaxes(step, 1, 2)) / (np.diff(self.times_ns) * 1e-9)[:, None]
        outer = _velocity_at_ends(np.where(both[:, None], mean, np.nan), at_end)
        rate[at_end] = np.where(np.isfinite(outer), outer, rate[at_end])
        return replace(posed, rate=rate, gyro=self.gyro)

    def is_end(self) -> BoolArray:
        """Return a mask (N,): True if the rotation to the frame before or to the next frame is unknown."""
        _, known = self.steps()
        return np.asarray(~(np.concatenate([[False], known]) & np.concatenate([known, [False]])))

    def _rate_or(self, other: FloatArray) -> FloatArray:
        """Return the rates (N,3); for frames that are alone in their segments, the rates `other`.

        A measured rate is kept.
        """
        return np.where((self.is_alone() & ~self.measured())[:, None], other, self.rate)

    def is_alone(self) -> BoolArray:
        """Return a mask (N,): True if the rotations to both adjacent frames are unknown."""
        return np.asarray(np.bincount(self.segment)[self.segment] == 1)

    def is_known(self, frame: int) -> bool:
        """Return True if the rotation between a frame and a frame beside it is known."""
        near = self.segment[max(0, frame - 1) : frame + 2] == self.segment[frame]
        return bool(near.sum() > 1)

    def row_uncertainty(self, frame: int, readout_s: float) -> float:
        """Return the expected error (radians) of the turn from the middle row of a frame to its other rows.

        It is the root mean square over the rows. It is 0 if the rotations to both adjacent frames are known,
        and if a gyroscope measured the turn. Otherwise the angular velocity is extrapolated, and its error is
        a part of the velocities around the frame.
        """
        if self.measured()[frame]:
            return 0.0
        around = slice(max(0, frame - 1), frame + 2)
        if len(self.times_ns[around]) == 3 and (self.segment[around] == self.segment[frame]).all():
            return 0.0
        rate = float(np.linalg.norm(self.rate[around], axis=1).max())
        return float(_EXTRAPOLATION_RATIO * rate * abs(readout_s) / np.sqrt(12.0))

    def turn(self, earlier: int, later: int) -> FloatArray | None:
        """Return the rotation (3,3) later_from_earlier between two frames; None if it is unknown."""
        if self.segment[earlier] != self.segment[later]:
            return None
        return np.asarray(self.rotation[later].T @ self.rotation[earlier])

    def frame_from_instant(self, frame: IntArray, delay_s: FloatArray) -> FloatArray:
        """Return the rotations (M,3,3) from the camera at some instants to the camera at the frame times.

        Args:
            frame: (M,) frame index of each instant.
            delay_s: (M,) seconds from the time of the frame to the instant.
        """
        return so3_exp(self.rotvec_to_instant(frame, delay_s)).reshape(-1, 3, 3)

    def rate_leverage_s(self, frame: IntArray, delay_s: FloatArray) -> FloatArray:
        """Return how much the angular velocity of frames turns the camera until some instants, seconds.

        It is less than the delay, because the orientations of the neighbouring frames stay as they are.

        Args:
            frame: Frame index of each instant, of any shape.
            delay_s: Seconds from the time of the frame to the instant, of the same shape.
        """
        other = np.clip(frame + np.where(delay_s < 0.0, -1, 1), 0, len(self.times_ns) - 1)
        inside = (other != frame) & (self.segment[other] == self.segment[frame])
        span_s = np.where(inside, (self.times_ns[other] - self.times_ns[frame]) * 1e-9, np.inf)
        return np.asarray(delay_s * (1.0 - delay_s / span_s) ** 2)

    def rate_deviations(self) -> FloatArray:
        """Return how far (N,) the angular velocity of each frame is from the mean of both neighbours, rad/s.

        At an end of a segment, it is the distance from the only neighbour; 0 without a neighbour.
        """
        known = (np.diff(self.segment) == 0)[:, None]
        step = np.where(known, np.diff(self.rate, axis=0), 0.0)
        nothing = np.zeros((1, 3))
        before, after = np.concatenate([nothing, step]), np.concatenate([step, nothing])
        sides = np.concatenate([[[False]], known]).astype(int) + np.concatenate([known, [[False]]])
        return np.asarray(np.linalg.norm((before - after) / np.maximum(sides, 1), axis=1))

    def rotvec_to_instant(self, frame: IntArray, delay_s: FloatArray) -> FloatArray:
        """Return the rotation vectors (M,3) of `frame_from_instant`, rad.

        Near a frame whose turn a gyroscope measured, it is this turn. Otherwise, between two frames of a
        segment, the rotation vector is a cubic polynomial of time. Outside a segment, the angular velocity is
        constant.
        """
        if self.gyro is not None and len(frame):
            seconds: FloatArray = np.asarray(self.times_ns[frame] * 1e-9, dtype=np.float64)
            turn = self.gyro.rotvec_between(seconds, delay_s)
            without = np.flatnonzero(~self.measured()[frame])
            if len(without):
                turn[without] = replace(self, gyro=None).rotvec_to_instant(frame[without], delay_s[without])
            return turn
        other = np.clip(frame + np.where(delay_s < 0.0, -1, 1), 0, len(self.times_ns) - 1)
        inside = (other != frame) & (self.segment[other] == self.segment[frame])
        rate = self.rate[frame]
        turn = np.asarray(rate * delay_s[:, None])
        f, g = frame[inside], other[inside]
        # Many instants share the interval between two frames. An interval that begins with the earlier frame
        # has an even number, else an odd number.
        interval, position = np.unique(2 * np.minimum(f, g) + (g < f), return_inverse=True)
        backward = interval % 2
        start, stop = interval // 2 + backward, interval // 2 + 1 - backward
        end = so3_log(np.swapaxes(self.rotation[start], 1, 2) @ self.rotation[stop])
        end_rate = _rotvec_rate(end, self.rate[stop])[position]
        span = ((self.times_ns[g] - self.times_ns[f]) * 1e-9)[:, None]
        u = delay_s[inside, None] / span
        # The cubic Hermite polynomial that starts at 0.
        turn[inside] = (
            u * (1.0 - u) ** 2 * span * rate[inside]
            + u**2 * (3.0 - 2.0 * u) * end[position]
            + u**2 * (u - 1.0) * span * end_rate
        )
        if self.acceleration is not None:
            turn += self.acceleration[frame] * (0.5 * delay_s * self.rate_leverage_s(frame, delay_s))[:, None]
        return turn


def _covered(times_ns: IntArray, gyro: GyroRates) -> BoolArray:
    """Return a mask (N,) of the frames for which samples cover the time halfway to both adjacent frames."""
    seconds: FloatArray = np.asarray(times_ns * 1e-9, dtype=np.float64)
    half_s = 0.5 * float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    return gyro.covers(seconds - half_s, seconds + half_s)


def _spline_rates(times_ns: IntArray, rotation: FloatArray, segment: IntArray) -> FloatArray:
    """Return the angular velocities (N,3) of the smoothest paths through the orientations of segments."""
    from scipy.spatial.transform import Rotation, RotationSpline

    class Smoothest(RotationSpline):
        TOL = _RATE_TOLERANCE

    rate = np.zeros((len(times_ns), 3))
    bounds = np.flatnonzero(np.diff(segment, prepend=-1, append=-1))
    for first, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        if stop - first > 1:
            seconds = (times_ns[first:stop] - times_ns[first]) * 1e-9
            spline = Smoothest(seconds, Rotation.from_matrix(rotation[first:stop]))
            rate[first:stop] = spline(seconds, 1)
        if stop - first > 2:
            # The spline has no acceleration at its ends. The velocity is extrapolated from two steps instead.
            for end, inwards in ((first, 1), (stop - 1, -1)):
                rate[end] = _end_rate(times_ns, rotation, np.arange(3) * inwards + end)
    return rate


def _end_rate(times_ns: IntArray, rotation: FloatArray, frames: IntArray) -> FloatArray:
    """Return the angular velocity (3,) at the first of three successive frames (3,), in either direction."""
    interval_s = np.diff(times_ns[frames]) * 1e-9
    step = so3_log(np.swapaxes(rotation[frames[:-1]], 1, 2) @ rotation[frames[1:]]) / interval_s[:, None]
    share = interval_s[0] / (interval_s[0] + interval_s[1])
    return np.asarray(step[0] + share * (step[0] - step[1]))


def _velocity_at_ends(slope: FloatArray, frame: IntArray) -> FloatArray:
    """Return velocities (M,3) at the ends of runs of poses, without the poses of these frames.

    It is the mean velocity between both neighbours on the side where there are poses. To continue its change
    is hardly more exact, but doubles the noise.

    Args:
        slope: (N-1,3) mean velocity between each frame and the next frame; NaN if it is unknown.
        frame: (M,) first or last frame of each run.

    Returns:
        The velocities; NaN for a frame that has no two neighbours with poses on one side.
    """
    nothing = np.full((2, 3), np.nan)
    padded = np.concatenate([nothing, slope, nothing])
    first = np.where(np.isfinite(padded[frame + 2]), padded[frame + 3], np.nan)
    return np.where(np.isfinite(padded[frame + 1]), padded[frame], first)


def _plausible(slope: FloatArray) -> FloatArray:
    """Return velocities (N,3), shortened to the largest plausible speed."""
    speed = np.linalg.norm(slope, axis=1)
    known = np.isfinite(speed)
    if not known.any():
        return slope
    limit = _MAX_SPEED_RATIO * float(np.percentile(speed[known], _SPEED_PERCENTILE))
    return np.asarray(slope * np.where(speed > limit, limit / np.maximum(speed, 1e-300), 1.0)[:, None])


def _mean_rates(times_ns: IntArray, rotation: FloatArray, segment: IntArray) -> FloatArray:
    """Return the angular velocities (N,3) from each frame's neighbours; NaN at the ends of segments."""
    out = np.full((len(times_ns), 3), np.nan)
    inner = np.flatnonzero(segment[2:] == segment[:-2]) + 1
    here = np.swapaxes(rotation[inner], 1, 2)
    before_s, after_s = (
        (times_ns[inner + a] - times_ns[inner + b])[:, None] * 1e-9 for a, b in ((0, -1), (1, 0))
    )
    before = -so3_log(here @ rotation[inner - 1]) / before_s
    after = so3_log(here @ rotation[inner + 1]) / after_s
    out[inner] = (after_s * before + before_s * after) / (before_s + after_s)
    return out


def _without_noise(rate: FloatArray, mean: FloatArray) -> FloatArray:
    """Return the rates (N,3) of a spline, shrunk towards mean rates (N,3) where the difference is noise.

    The spline follows a fast motion better than the mean of two steps, but it amplifies the noise of the
    orientations. The differences of the quietest quarter of the frames are taken for noise.

    Source: James, Stein, "Estimation with quadratic loss", 1961, for the shrinkage.
    """
    difference = rate - mean
    size = np.linalg.norm(difference, axis=1)
    known = np.isfinite(size)
    if not known.any():
        return rate
    noise = _NOISE_FROM_QUARTILE * float(np.quantile(size[known], 0.25))
    kept = np.maximum(0.0, 1.0 - (noise / np.maximum(size, 1e-12)) ** 2)
    return np.where(known[:, None], mean + kept[:, None] * difference, rate)


def _rotvec_rate(rotvec_rad: FloatArray, rate: FloatArray) -> FloatArray:
    """Return the time derivatives (M,3) of rotation vectors (M,3), for angular velocities (M,3) of the body.

    Source: Bortz, "A new mathematical formulation for strapdown inertial navigation", 1971.
    """
    angle = np.linalg.norm(rotvec_rad, axis=1)[:, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    factor = np.where(small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    cross = np.cross(rotvec_rad, rate)
    return np.asarray(rate + 0.5 * cross + factor * np.cross(rotvec_rad, cross))


def near_in_time(times_ns: IntArray) -> BoolArray:
    """Return a mask (N-1,): True if a frame and the next frame are near in time."""
    interval_ns = np.diff(times_ns)
    if len(interval_ns) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(interval_ns <= _MAX_GAP_FRAMES * np.median(interval_ns))


def rotate_to_mid_row(
    camera: Camera, path: RotationPath, frame: IntArray, px: FloatArray, readout_s: float
) -> FloatArray:
    """Return where pixels would be at the instant of the middle row if the camera only rotated.

    Args:
        camera: The camera model.
        path: The rotation of the camera.
        frame: (M,) frame index of each pixel.
        px: (M,2) observed pixels.
        readout_s: Readout time, seconds.

    Returns:
        The moved pixels (M,2). A pixel is not moved if the camera model has no ray for it, or if its ray is
        behind the camera at the other instant.

    Source: Forssén, Ringaby, "Rectifying rolling shutter video from hand-held devices", CVPR 2010.
    """
    rays = unit_directions(camera.unproject(px))
    turned = np.einsum("mij,mj->mi", path.frame_from_instant(frame, row_delay(camera, px) * readout_s), rays)
    return _projected_or(camera, turned, px)


@dataclass(frozen=True, slots=True)
class TurningShutter:
    """The rolling shutter of a camera whose rotation is known, but whose position is not.

    Attributes:
        camera: The camera model.
        path: The rotation of the camera.
        readout_s: Readout time, seconds.
    """

    camera: Camera
    path: RotationPath
    readout_s: float

    def px_at_mid_row(self, frame: IntArray, px: FloatArray) -> FloatArray:
        """Return where pixels (M,2) in frames (M,) would be at the instant of the middle row."""
        return rotate_to_mid_row(self.camera, self.path, frame, px, self.readout_s)

    def uncertainty(self, frame: int) -> float:
        """Return the expected error of the turn from the middle row of a frame to its other rows, radians."""
        return self.path.row_uncertainty(frame, self.readout_s)

    def px_in_picture(self, frame: IntArray, px: FloatArray) -> FloatArray:
        """Return where points are seen in frames (M,), for their pixels (M,2) at the middle row's instant.

        The instant at which a point is exposed depends on where it is seen, so this is repeated.
        """
        rays = unit_directions(self.camera.unproject(px))
        seen = px
        for _ in range(_ROW_ROUNDS):
            delay_s = row_delay(self.camera, seen) * self.readout_s
            turned = np.einsum("mji,mj->mi", self.path.frame_from_instant(frame, delay_s), rays)
            seen = _projected_or(self.camera, turned, px)
        return seen


@dataclass(frozen=True, slots=True)
class PosePath:
    """The poses of a camera over time: a spline of its orientation, and a parabola of its position.

    The parabola of a frame passes through the positions of the frame and of both neighbouring frames. If one
    of them has no pose, it is a straight line. If none has a pose, the position is constant.

    Attributes:
        map_from_cam: (N,4,4) poses of the frames; NaN for a frame without a pose.
        rotation: The orientation over time.
        velocity: (N,3) velocity of the camera at each frame time, map units per second.
        acceleration: (N,3) acceleration of the camera at each frame time, map units per second squared.
        rate_sigma: (N,) standard deviation of the angular velocity of each frame about an axis, rad/s, before
            the observations of the frame are used; None if it is unknown.
    """

    map_from_cam: FloatArray
    rotation: RotationPath
    velocity: FloatArray
    acceleration: FloatArray
    rate_sigma: FloatArray | None = None

    @staticmethod
    def create(
        map_from_cam: FloatArray,
        times_ns: IntArray,
        rotation: RotationPath | None = None,
        *,
        shrunk: bool = True,
    ) -> PosePath:
        """Return the path through poses.

        Args:
            map_from_cam: (N,4,4) poses of the frames; NaN for a frame without a pose.
            times_ns: (N,) frame times, nanoseconds.
            rotation: The rotation between frames without poses; None if it is unknown.
            shrunk: The same as for `RotationPath.from_steps`.
        """
        count = len(times_ns)
        if rotation is None:
            unknown = np.zeros(max(0, count - 1), dtype=bool)
            rotation = RotationPath.from_steps(times_ns, np.tile(np.eye(3), (len(unknown), 1, 1)), unknown)
        velocity, acceleration = np.zeros((count, 3)), np.zeros((count, 3))
        if count > 1:
            interval_s = np.diff(times_ns) * 1e-9
            slope = np.diff(map_from_cam[:, :3, 3], axis=0) / interval_s[:, None]
            slope[~near_in_time(times_ns)] = np.nan
            slope = _plausible(slope)
            nothing = np.full((1, 3), np.nan)
            before, after = np.concatenate([nothing, slope]), np.concatenate([slope, nothing])
            span = np.concatenate([interval_s[:1], 0.5 * (interval_s[1:] + interval_s[:-1]), interval_s[-1:]])
            bend = np.nan_to_num((after - before) / span[:, None])
            # The slope between two frames is the velocity in the middle of their interval.
            from_before = before + 0.5 * np.concatenate([[0.0], interval_s])[:, None] * bend
            inner = np.isfinite(from_before + after)[:, :1]
            # At the first and the last pose of a part, the acceleration is that of the neighbouring frame.
            behind, ahead = np.zeros((count, 3)), np.zeros((count, 3))
            behind[1:], ahead[:-1] = bend[:-1], bend[1:]
            step_s = np.concatenate([interval_s, [0.0]])[:, None]
            at_start = after - 0.5 * step_s * ahead
            at_end = before + 0.5 * np.concatenate([[0.0], interval_s])[:, None] * behind
            velocity = np.where(
                inner, from_before, np.nan_to_num(np.where(np.isfinite(after), at_start, at_end))
            )
            acceleration = np.where(inner, bend, np.where(np.isfinite(after), ahead, behind))
            acceleration[~np.isfinite(after) & ~np.isfinite(before)] = 0.0
            # The position of a frame at an end depends on its own velocity. It is left out there.
            ends = np.flatnonzero(~inner[:, 0])
            outer = _velocity_at_ends(slope, ends)
            velocity[ends] = np.where(np.isfinite(outer), outer, velocity[ends])
        return PosePath(
            map_from_cam, rotation.with_poses(map_from_cam, shrunk=shrunk), velocity, acceleration
        )

    def px_at_mid_row(
        self, camera: Camera, frame: IntArray, points: FloatArray, px: FloatArray, readout_s: float
    ) -> FloatArray:
        """Return where observed pixels would be at the instant of the middle row.

        Args:
            camera: The camera model.
            frame: (M,) frame index of each observation.
            points: (M,3) observed map point of each observation, in the map frame.
            px: (M,2) observed pixels.
            readout_s: Readout time, seconds.

        Returns:
            The moved pixels (M,2). In a frame without a pose, and for a point behind the camera, only the
            rotation is corrected.
        """
        delay_s = row_delay(camera, px) * readout_s
        from_instant = self.rotation.frame_from_instant(frame, delay_s)
        shift = self._shift_in_cam(frame, delay_s)
        pose = self.map_from_cam[frame]
        x_in_cam = np.einsum("mji,mj->mi", pose[:, :3, :3], points - pose[:, :3, 3])
        depth = np.einsum("mi,mi->m", from_instant[:, :, 2], x_in_cam - shift)
        return self._moved(camera, from_instant, shift, depth, px)

    def with_fitted_rates(
        self, camera: Camera, frame: IntArray, points: FloatArray, px: FloatArray, readout_s: float
    ) -> PosePath:
        """Return the path with angular velocities and accelerations that fit the observations of each frame.

        A hand shakes faster than its video can show from frame to frame. But the rows of a frame are exposed
        one after another, so the observations of a frame determine its angular velocity, and how this changes
        during the readout. A correction of both is fitted together with a correction of the pose, which is
        not used. The prior of a velocity is the usual size of the corrections of a camera, or a part of the
        deviation of the velocity from its neighbours if this is more. The prior of an acceleration is a part
        of this deviation, too. What a gyroscope measured is kept.

        Args:
            camera: The camera model.
            frame: (M,) frame index of each observation, in any order.
            points: (M,3) observed map point of each observation, in the map frame.
            px: (M,2) observed pixels.
            readout_s: Readout time, seconds. It must be known: velocities explain a wrong one.

        Source: Albl, Kukelova, Pajdla, "R6P - Rolling shutter absolute camera pose", CVPR 2015, for the model
            of a frame with an angular velocity.
        """
        if self.rotation.measured().all():
            return replace(self, rate_sigma=np.zeros(len(self.rotation.rate)))
        moved = camera.unproject(self.px_at_mid_row(camera, frame, points, px, readout_s))
        pose = self.map_from_cam[frame]
        x_in_cam = np.einsum("mji,mj->mi", pose[:, :3, :3], points - pose[:, :3, 3])
        with np.errstate(invalid="ignore", divide="ignore"):
            expected = x_in_cam[:, :2] / x_in_cam[:, 2:]
        residual = moved - expected
        limit = _MAX_RATE_RESIDUAL_PX * pixel_scale(camera.width_px, camera.height_px) / camera.focal_px
        with np.errstate(invalid="ignore"):
            used = (x_in_cam[:, 2] > 0.0) & (np.linalg.norm(residual, axis=1) < limit)
        rows = np.flatnonzero(used)
        rows = rows[np.argsort(frame[rows], kind="stable")]
        delay_s = row_delay(camera, px[rows]) * readout_s
        leverage_s = self.rotation.rate_leverage_s(frame[rows], delay_s)
        turn = _turn_jacobian(moved[rows])
        move = np.zeros((len(rows), 2, 3))
        move[:, 0, 0] = move[:, 1, 1] = 1.0
        move[:, :, 2] = -moved[rows]
        # A translation is measured in units of the depth of the points: the parts have similar sizes then.
        move *= (np.median(x_in_cam[rows, 2]) if len(rows) else 1.0) / x_in_cam[rows, 2][:, None, None]
        # The unknown of the acceleration is the change of the velocity in a frame interval.
        intervals_ns = np.diff(self.rotation.times_ns)
        interval_s = 1e-9 * float(np.median(intervals_ns)) if len(intervals_ns) else 1.0
        gain = np.column_stack([leverage_s, 0.5 * delay_s * leverage_s / interval_s])
        jacobian = np.concatenate([turn, move, *(gain.T[:, :, None, None] * turn)], axis=2)
        noise = _RATE_NOISE_PX * pixel_scale(camera.width_px, camera.height_px) / camera.focal_px
        end = _END_RATE_SIGMA + _END_RATE_SIGMA_RATIO * np.linalg.norm(self.rotation.rate, axis=1)
        end[~self.rotation.is_end()] = 0.0
        deviation = self.rotation.rate_deviations()
        change, sigma = _fit_frames(frame[rows], residual[rows], jacobian, noise, end, deviation)
        change[self.rotation.measured()] = 0.0
        sigma[self.rotation.measured()] = 0.0
        rate, acceleration = self.rotation.rate + change[:, :3], change[:, 3:] / interval_s
        rotation = replace(self.rotation, rate=rate, acceleration=acceleration)
        return replace(self, rotation=rotation, rate_sigma=sigma)

    def velocity_errors(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the expected errors of the velocities of the frames, along each axis.

        They follow from the deviations of a frame's velocities from those of its neighbours. They are larger
        where a velocity is extrapolated.

        Returns:
            Errors (N,) of the angular velocity, rad/s; of its change in a frame interval, rad/s; and of the
            velocity, map units per second.
        """
        turning = self.rotation
        deviation = np.where(turning.measured(), 0.0, turning.rate_deviations())
        rate = np.maximum(_MIN_RATE_SIGMA, _RATE_DEVIATION_RATIO * deviation)
        at_end = turning.is_end() & ~turning.measured()
        end = _END_RATE_SIGMA + _END_RATE_SIGMA_RATIO * np.linalg.norm(turning.rate, axis=1)
        rate = np.where(at_end, np.maximum(rate, end), rate)
        rate = np.where(at_end & turning.is_alone(), _RATE_SIGMA, rate)
        change = np.maximum(_MIN_RATE_SIGMA, _ACCELERATION_DEVIATION_RATIO * deviation)
        has_pose: BoolArray = np.asarray(np.isfinite(self.map_from_cam).all(axis=(1, 2)))
        linked = has_pose[1:] & has_pose[:-1] & near_in_time(turning.times_ns)
        nothing = np.zeros(1, dtype=bool)
        inner: BoolArray = np.asarray(np.concatenate([nothing, linked]) & np.concatenate([linked, nothing]))
        step = np.diff(self.velocity, axis=0)
        bend = np.zeros(len(inner))
        bend[1:-1] = 0.5 * np.linalg.norm(step[:-1] - step[1:], axis=1)
        # A neighbour at an end has an extrapolated velocity, so its deviation is no measure.
        usual = float(np.median(bend[inner])) if inner.any() else 0.0
        speed = np.linalg.norm(self.velocity[has_pose], axis=1)
        if not linked.any():
            # No velocity is known, so the speed follows from poses that are further apart.
            apart_s = np.diff(turning.times_ns[has_pose])[:, None] * 1e-9
            speed = np.linalg.norm(np.diff(self.map_from_cam[has_pose, :3, 3], axis=0) / apart_s, axis=1)
        fast = float(np.percentile(speed, _SPEED_PERCENTILE)) if len(speed) else 0.0
        velocity = _VELOCITY_DEVIATION_RATIO * np.maximum(bend, usual)
        velocity = np.where(inner, velocity, np.maximum(velocity, _EXTRAPOLATION_RATIO * fast))
        return rate, change, np.maximum(velocity, _MIN_SPEED_SIGMA_RATIO * fast)

    def rate_leverage_s(
        self, camera: Camera, frame: IntArray, px: FloatArray, readout_s: float
    ) -> FloatArray:
        """Return the seconds (M,) by which the angular velocity of a frame turns the rays of its pixels.

        Args:
            camera: The camera model.
            frame: (M,) frame index of each observation.
            px: (M,2) observed pixels.
            readout_s: Readout time, seconds.
        """
        return self.rotation.rate_leverage_s(frame, row_delay(camera, px) * readout_s)

    def turn_and_shift(
        self, camera: Camera, frame: IntArray, px: FloatArray, readout_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the motion of the camera from frame times until pixels are exposed.

        Args:
            camera: The camera model.
            frame: (M,) frame index of each pixel.
            px: (M,2) observed pixels.
            readout_s: Readout time, seconds.

        Returns:
            The rotation vectors (M,3) from the camera at the exposure to the camera at the frame time, rad;
            and the shifts (M,3) of the camera in its frame at the frame time, map units. The shift is 0 in a
            frame without a pose.
        """
        delay_s = row_delay(camera, px) * readout_s
        shift = np.nan_to_num(self._shift_in_cam(frame, delay_s))
        return self.rotation.rotvec_to_instant(frame, delay_s), shift

    def _shift_in_cam(self, frame: IntArray, delay_s: FloatArray) -> FloatArray:
        """Return how far (M,3) the camera moves from frame times to instants, in its frame of the frame time.

        The result is NaN for a frame without a pose.
        """
        delay = delay_s[:, None]
        shift = self.velocity[frame] * delay + 0.5 * self.acceleration[frame] * delay**2
        return np.asarray(np.einsum("mji,mj->mi", self.map_from_cam[frame][:, :3, :3], shift))

    @staticmethod
    def _moved(
        camera: Camera, from_instant: FloatArray, shift: FloatArray, depth: FloatArray, px: FloatArray
    ) -> FloatArray:
        """Return pixels (M,2) after the rotation, and after the shift where shift and depth are known."""
        rays = camera.unproject(px)
        rays = np.column_stack([rays, np.ones(len(rays))])
        has_depth = np.isfinite(depth) & (depth > 0.0) & np.isfinite(shift).all(axis=1)
        scaled = rays * np.where(has_depth, depth, 1.0)[:, None]
        moved = np.einsum("mij,mj->mi", from_instant, scaled) + np.where(has_depth[:, None], shift, 0.0)
        return _projected_or(camera, moved, px)


def _turn_jacobian(ray: FloatArray) -> FloatArray:
    """Return the derivatives (M,2,3) of image points (M,2) at depth 1 for a turn of their rays."""
    x, y = ray[:, 0], ray[:, 1]
    one = np.ones(len(ray))
    return np.stack(
        [np.stack([-x * y, one + x * x, -y], axis=1), np.stack([-one - y * y, x * y, x], axis=1)], axis=1
    )


def _fit_frames(
    frame: IntArray,
    residual: FloatArray,
    jacobian: FloatArray,
    noise: float,
    end_sigma: FloatArray,
    deviation: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Fit corrections of poses, angular velocities and accelerations to residuals of frames, robustly.

    Args:
        frame: (M,) frame index of each residual, not decreasing.
        residual: (M,2) residuals.
        jacobian: (M,2,12) derivatives of the residuals with respect to turn, shift, angular velocity and
            its change in a frame interval.
        noise: Standard deviation of a residual.
        end_sigma: (N,) least expected error of the angular velocity of each frame, rad/s.
        deviation: (N,) deviation of the angular velocity of each frame from its neighbours, rad/s.

    Returns:
        The corrections (N,6) of the angular velocities and of their changes, rad/s; 0 for a frame with too
        few residuals. And the expected size (N,) of a correction of the angular velocity, rad/s.
    """
    out = np.zeros((len(end_sigma), 6))
    expected = np.maximum(end_sigma, _RATE_DEVIATION_RATIO * deviation)
    frames, starts, sizes = np.unique(frame, return_index=True, return_counts=True)
    enough = sizes >= _MIN_RATE_POINTS
    if not enough.any():
        return out, np.maximum(_RATE_SIGMA, expected)
    sigma = _RATE_SIGMA
    deviation = np.where(sizes >= _MIN_LOOSE_POINTS, deviation[frames], 0.0)
    loose = np.where(sizes >= _MIN_LOOSE_POINTS, expected[frames], 0.0)
    bent = np.maximum(_ACCELERATION_DEVIATION_RATIO * deviation, _MIN_RATE_SIGMA)
    unknowns = np.arange(jacobian.shape[2])
    solution: FloatArray = np.zeros((len(frames), len(unknowns)))
    position = np.repeat(np.arange(len(frames)), sizes)
    for _ in range(_RATE_FITS):
        left = residual + np.einsum("mij,mj->mi", jacobian, solution[position])
        weight = 1.0 / (noise**2 + np.einsum("mi,mi->m", left, left))
        normal = np.empty((len(frames), len(unknowns), len(unknowns)))
        right = np.empty((len(frames), len(unknowns)))
        for start in range(0, len(frames), _RATE_BATCH_FRAMES):
            part = slice(start, start + _RATE_BATCH_FRAMES)
            first, stop = int(starts[part][0]), int(starts[part][-1] + sizes[part][-1])
            inner = starts[part] - first
            weighted = jacobian[first:stop] * weight[first:stop, None, None]
            normal[part] = np.add.reduceat(np.swapaxes(weighted, 1, 2) @ jacobian[first:stop], inner, axis=0)
            right[part] = np.add.reduceat(
                np.einsum("mia,mi->ma", weighted, residual[first:stop]), inner, axis=0
            )
        prior = np.full((len(frames), len(unknowns)), 1e-6 / noise**2)
        prior[:, 6:9] = 1.0 / np.maximum(sigma, loose)[:, None] ** 2
        prior[:, 9:] = 1.0 / bent[:, None] ** 2
        normal[:, unknowns, unknowns] += prior
        solution = np.asarray(-np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)
        size = np.linalg.norm(solution[enough, 6:9], axis=1)
        sigma = float(np.clip(np.median(size), _MIN_RATE_SIGMA, _RATE_SIGMA))
    out[frames[enough]] = solution[enough, 6:]
    return out, np.maximum(sigma, expected)


def _projected_or(camera: Camera, x_in_cam: FloatArray, px: FloatArray) -> FloatArray:
    """Return the projections (M,2) of points, or the pixel in `px` (M,2) for a point without a projection."""
    projected = camera.project(x_in_cam)
    is_seen = np.asarray(np.isfinite(projected).all(axis=1))
    return np.where(is_seen[:, None], projected, px)
