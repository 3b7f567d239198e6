"""Adjust a map of rolling shutters together with the motion of its cameras, in a few passes.

Each pass starts from what the last one found: the paths of the cameras between their keyframes, the noise of
the observations, and how wrong the velocities of the paths usually are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.mapping.reconstruction.camera_motion import camera_motions
from bodycap_batch.mapping.reconstruction.reduced_system import CommonPoints
from bodycap_batch.mapping.reconstruction.rolling_adjustment import (
    MotionErrors,
    RollingMap,
    RowObservations,
    adjust_with_velocities,
    correction_ratios,
    px_at_mid_row,
    readout_errors,
    usual_residual_px,
    velocity_squares,
)
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import interpolate_pose, invert, make_transform
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_path import RotationPath

MIN_SIGMAS = 3.0
"""Minimum ratio of a readout time to its standard deviation. Origin: the correction then removes at least two
thirds of the displacements."""
MAX_GLOBAL_S = 0.002
"""A shutter is treated as global if its readout time is shorter than this value (seconds) with 95 %
probability. Evidence: none."""
_NOISE_PX = 0.7
"""Standard deviation of an observation in the first pass, px of an image with a long side of 640 px. Origin:
the same as for angular velocities in `model.rotation_path`."""
_WIDE_LOSS_WIDTH = 4.0
"""Width of the loss in the first pass, in standard deviations of an observation. It keeps observations that
disagree because the velocities of the path are wrong. The later width is the median residual at the start of
the pass. Evidence: docs/decisions/mapping.md."""
_PASSES = 3
"""Number of passes. Evidence: docs/decisions/mapping.md."""
_FIRST_SCALE = 1.0 / 3.0
"""Factor of the expected errors of the velocities in the first pass. With few keyframes, larger errors let
poses and points follow wrong velocities. Evidence: docs/decisions/mapping.md."""
_MEDIAN_OF_NORMAL = 0.6745
"""Median absolute value of a normal variable, in its standard deviations."""
_EXACT_RATIO = 0.5
"""A path is exact enough if its expected errors displace keypoints by less than this ratio of the noise.
Origin: they then add 12 % to the noise."""
_EXACT_PERCENT = 95.0
"""Percentile of these displacements. Evidence: none."""
_NO_MOTION_SIGMA = 1e-6
"""Expected error of a velocity that moves no observation, and of a given readout time as a ratio. It only
prevents a division by zero."""
_FREEDOM = 3.0
"""Degrees of freedom of the distribution of the errors of velocities: a few errors are much larger than
usual, where a hand hits something or the recorded motion jumps. Evidence: docs/decisions/mapping.md."""
_MAX_POOLED_SIGMAS = 3.0
"""Maximum deviation of the readout time of a camera from the mean of equal cameras, in its standard
deviations. With a larger deviation, the cameras do not share one. Evidence: none."""
_MIN_SCALE_S = 0.0001
"""Smallest readout time (seconds) with which motions are computed. It only makes the displacements by a
short readout time proportional to something."""
_SYSTEMATIC_PX = 0.02
"""Systematic error of detected pixels, px of an image with a long side of 640 px. Evidence:
docs/decisions/mapping.md."""
_COMMON_RATIO = 0.25
"""Part of the usual error of the velocities of a path that all velocities have in common, because a spline is
too smooth. A readout time is wrong by this part. Evidence: docs/decisions/mapping.md."""
_MIN_KEYFRAMES = 4
"""Minimum number of keyframes that determine a readout time. With fewer, the scatter of single keyframes is
unknown. Evidence: docs/decisions/mapping.md."""
_SCALE_STEPS = 200
"""Number of steps in which the usual size of the errors is computed. It only bounds the computing time: a
step takes microseconds, and in 8 maps at most 16 steps gave the size to 0.1 %."""
_MIN_OBSERVATIONS = 12
"""Minimum number of observations of a keyframe that show how wrong velocities are. Evidence: none."""
_MIN_SCALE = 0.05
"""Smallest factor of the expected errors of velocities. It only prevents that an exact path leaves no
freedom."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedReadout:
    """A readout time after an adjustment.

    Attributes:
        seconds: Readout time for which the map was adjusted, seconds; 0 if the adjustment shows that the
            shutter is global, as far as it can show it.
        best_s: Most likely readout time, seconds.
        sigma_s: Its standard deviation, seconds; None if the readout time was constant.
    """

    seconds: float
    best_s: float
    sigma_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedMap:
    """The result of an adjustment.

    Attributes:
        cam_from_map: (K,4,4) poses of the keyframes at the exposure of the middle row.
        points: (P,3) points in the map frame.
        px_at_mid_row: (M,2) observed pixels at the exposure of the middle row.
        readouts: Readout times by camera name.
        error_scales: (N,3) factors of the expected errors of the velocities of each frame, by camera name.
            They are 1 for a frame that is no keyframe.
    """

    cam_from_map: FloatArray
    points: FloatArray
    px_at_mid_row: FloatArray
    readouts: dict[str, AdjustedReadout]
    error_scales: dict[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Readouts:
    """The readout times of an adjustment. Cameras of one model share one.

    Attributes:
        seconds: (R,) readout times so far, seconds; one of 0 without rolling shutters.
        number: Number of the readout time of each camera with a rolling shutter, by camera name.
        expected_s: (R,2) expected values before the adjustment and their standard deviations, seconds. A
            readout time with a standard deviation of 0 is constant.
        best_s: (R,) most likely readout times, seconds.
        sigma_s: (R,) their standard deviations, seconds; NaN for one that was always constant.
    """

    seconds: FloatArray
    number: Mapping[str, int]
    expected_s: FloatArray
    best_s: FloatArray
    sigma_s: FloatArray

    @staticmethod
    def create(
        readout_s: Mapping[str, float],
        expected_s: Mapping[str, tuple[float, float]],
        groups: Sequence[Sequence[str]],
        uninformative: Collection[str] = (),
    ) -> _Readouts:
        """Return the readout times at the start; see `MotionAdjustment.run`.

        Args:
            readout_s: Readout times by camera name, seconds.
            expected_s: Expected values and standard deviations by camera name, seconds.
            groups: Groups of names of equal cameras.
            uninformative: Names of the cameras whose motion does not determine a readout time. They
                follow an equal camera that starts from the same one.
        """
        group_of = {name: number for number, group in enumerate(groups) for name in group}
        keys: dict[str, tuple[object, ...]] = {
            name: (group_of.get(name, name), readout_s[name], *expected_s[name]) for name in readout_s
        }
        for name in keys.keys() & set(uninformative):
            others = [
                keys[other] for other in sorted(keys.keys() - set(uninformative)) if expected_s[other][1]
            ]
            same = [key for key in others if key[:2] == keys[name][:2]]
            keys[name] = same[0] if same else (name, *keys[name])
        different = list(dict.fromkeys(keys.values()))
        number = {name: different.index(key) for name, key in keys.items()}
        first = {index: name for name, index in reversed(number.items())}
        names = [first[index] for index in range(len(different))]
        seconds = np.array([readout_s[name] for name in names] or [0.0])
        return _Readouts(
            seconds=seconds,
            number=number,
            expected_s=np.array([expected_s[name] for name in names] or [(0.0, 0.0)], dtype=np.float64),
            best_s=seconds,
            sigma_s=np.full(len(seconds), np.nan),
        )

    @property
    def scale_s(self) -> FloatArray:
        """Readout times (R,) of the motions of the observations, seconds; never 0."""
        return np.copysign(np.maximum(np.abs(self.seconds), _MIN_SCALE_S), self.seconds)

    @property
    def constant(self) -> BoolArray:
        """Mask (R,) of the readout times that are not adjusted."""
        return np.asarray(self.expected_s[:, 1] == 0.0)

    def kept(self, uncertain: BoolArray) -> _Readouts:
        """Return the readout times with constant values where a mask (R,) is true.

        They stay as they are, or become 0 if a global shutter may have them.
        """
        sigma_s = np.where(uncertain & ~self.constant, self.expected_s[:, 1], np.nan)
        short = replace(self, sigma_s=sigma_s).without_short_ones()
        none = short.constant & ~self.constant
        sigma_s = np.where(none, sigma_s, np.nan)
        return replace(short.held(uncertain, short.seconds), sigma_s=sigma_s)

    def held(self, kept: BoolArray, seconds: FloatArray | float) -> _Readouts:
        """Return the readout times with constant values (seconds) where a mask (R,) is true."""
        changed = np.where(kept, seconds, self.seconds)
        expected = np.where(kept[:, None], np.stack([changed, np.zeros(len(kept))], axis=1), self.expected_s)
        return replace(self, seconds=changed, expected_s=expected)

    def after_pass(self, ratio: FloatArray, sigma_s: FloatArray) -> _Readouts:
        """Return the readout times after a pass.

        Args:
            ratio: (R,) ratios of the readout times to those of the observations.
            sigma_s: (R,) standard deviations of the new readout times, seconds.
        """
        seconds = np.where(self.constant, self.seconds, self.scale_s * ratio)
        return replace(
            self,
            seconds=seconds,
            best_s=np.where(self.constant, self.best_s, seconds),
            sigma_s=np.where(self.constant, self.sigma_s, sigma_s),
        )

    def without_short_ones(self) -> _Readouts:
        """Return the readout times with a constant 0 for those that a global shutter may have."""
        size_s = np.abs(self.seconds)
        with np.errstate(invalid="ignore"):
            short = (size_s < MIN_SIGMAS * self.sigma_s) & (size_s + 2.0 * self.sigma_s < MAX_GLOBAL_S)
        return self.held(short & ~self.constant, 0.0)

    def shared(self, groups: Sequence[Sequence[str]]) -> _Readouts:
        """Return the readout times with one for the cameras of each group whose times agree.

        Their common time is the mean that is weighted by the information of each. A constant time is kept.

        Args:
            groups: Groups of names of equal cameras.
        """
        out = self
        for group in groups:
            own = np.unique([out.number[name] for name in group if name in out.number]).astype(np.int64)
            own = own[~out.constant[own]]
            if len(own) < 2 or not np.isfinite(out.sigma_s[own]).all():
                continue
            told, sigma_s = out.seconds[own], np.maximum(out.sigma_s[own], 1e-9)
            mean_s = float(np.average(told, weights=1.0 / sigma_s**2))
            if (np.abs(told - mean_s) > _MAX_POOLED_SIGMAS * sigma_s).any():
                continue
            parts = out.seconds.copy(), out.best_s.copy(), out.sigma_s.copy(), out.expected_s.copy()
            seconds, best_s, sigmas, expected = parts
            seconds[own[0]] = best_s[own[0]] = mean_s
            sigmas[own[0]] = (1.0 / sigma_s**2).sum() ** -0.5
            expected[own[0]] = expected[own[np.argmin(expected[own, 1])]]
            number = {name: int(own[0]) if index in own else index for name, index in out.number.items()}
            out = replace(
                out, seconds=seconds, number=number, expected_s=expected, best_s=best_s, sigma_s=sigmas
            )
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionAdjustment:
    """An adjustment of keyframes, points, velocities and readout times.

    K is the number of keyframes, M the number of observations.

    Attributes:
        lenses: Camera models by camera name.
        poses: Poses map_from_cam (N,4,4) and times (N,) in nanoseconds of the frames, by camera name.
        rotations: Rotations of the cameras between frames without poses, by camera name.
        camera: (K) camera names of the keyframes.
        frame: (K,) frame indices of the keyframes.
        keyframe: (M,) keyframe of each observation, not decreasing.
        point: (M,) observed point.
        px: (M,2) detected pixel.
        equal_cameras: Groups of names of cameras that may be of one model.
        uninformative: Names of the cameras whose motion is too smooth to determine a readout time.
    """

    lenses: Mapping[str, Camera]
    poses: Mapping[str, tuple[FloatArray, IntArray]]
    rotations: Mapping[str, RotationPath]
    camera: tuple[str, ...]
    frame: IntArray
    keyframe: IntArray
    point: IntArray
    px: FloatArray
    equal_cameras: Sequence[Sequence[str]] = ()
    uninformative: Collection[str] = ()

    def run(
        self,
        cam_from_map: FloatArray,
        points: FloatArray,
        readout_s: Mapping[str, float],
        expected_s: Mapping[str, tuple[float, float]],
    ) -> AdjustedMap | None:
        """Return the adjusted map; None if the velocities of the paths are exact enough.

        Equal cameras have one unknown readout time in common if they start from the same one, or if their
        readout times agree after a pass.

        Args:
            cam_from_map: (K,4,4) poses of the keyframes at the start.
            points: (P,3) points at the start.
            readout_s: Readout times of the cameras with rolling shutters at the start, by camera name,
                seconds.
            expected_s: Their expected values and standard deviations before the adjustment, seconds. A
                readout time with a standard deviation of 0 is constant.
        """
        readouts = _Readouts.create(readout_s, expected_s, self.equal_cameras, self.uninformative)
        scales: FloatArray = np.full((len(self.camera), 3), _FIRST_SCALE)
        found = RollingMap(
            cam_from_map=cam_from_map,
            points=points,
            velocities=np.zeros((len(cam_from_map), 9)),
            readout_ratio=np.ones(len(readouts.seconds)),
        )
        noise_px = _NOISE_PX * max(
            pixel_scale(each.width_px, each.height_px) for each in self.lenses.values()
        )
        wide_px = _WIDE_LOSS_WIDTH * noise_px
        common_points = CommonPoints.of(self.keyframe, self.point)
        for passed in range(_PASSES):
            seen, own = self._observations(found.cam_from_map, readouts, noise_px, common_points)
            if not passed:
                readouts = readouts.kept(self._uncertain(seen, readouts))
            if not passed and self._is_exact_enough(seen, _motion_errors(own, readouts)):
                return None
            errors = _motion_errors(own * scales, readouts)
            found = replace(
                found,
                velocities=np.zeros_like(found.velocities),
                readout_ratio=readouts.seconds / readouts.scale_s,
            )
            width_px = usual_residual_px(seen, found) if passed else wide_px
            found = adjust_with_velocities(seen, found, errors, width_px)
            readouts = self._after_pass(seen, found, errors, readouts, width_px)
            if passed < _PASSES - 1:
                readouts = readouts.shared(self.equal_cameras)
            if passed == _PASSES - 2:
                readouts = readouts.without_short_ones()
            noise_px = usual_residual_px(seen, found) / _MEDIAN_OF_NORMAL
            squares, variances = velocity_squares(replace(seen, noise_px=noise_px), found, errors)
            scales = self._error_scales((squares + variances) / own**2)
        return AdjustedMap(
            cam_from_map=found.cam_from_map,
            points=found.points,
            px_at_mid_row=px_at_mid_row(seen, found),
            readouts={
                name: AdjustedReadout(
                    seconds=float(readouts.seconds[index]),
                    best_s=float(readouts.best_s[index]),
                    sigma_s=None if np.isnan(readouts.sigma_s[index]) else float(readouts.sigma_s[index]),
                )
                for name, index in readouts.number.items()
            },
            error_scales=self._scales_of_frames(scales),
        )

    def _observations(
        self, cam_from_map: FloatArray, readouts: _Readouts, noise_px: float, common_points: CommonPoints
    ) -> tuple[RowObservations, FloatArray]:
        """Return all observations, and the expected errors (K,3) of the velocities of the paths.

        Args:
            cam_from_map: (K,4,4) poses of the keyframes so far.
            readouts: The readout times so far.
            noise_px: Standard deviation of an observation, px.
            common_points: The points that pairs of keyframes have in common.
        """
        names, camera = sorted(self.lenses), np.array(self.camera)
        delay = np.zeros(len(self.px))
        turn, shift = np.zeros((len(self.px), 3)), np.zeros((len(self.px), 3))
        errors, interval_s = np.full((len(camera), 3), _NO_MOTION_SIGMA), np.ones(len(camera))
        poses = {name: self._moved_poses(name, cam_from_map) for name in self.poses}
        readout_s = {name: float(readouts.scale_s[index]) for name, index in readouts.number.items()}
        motions = camera_motions(self.lenses, poses, self.rotations, readout_s, {})
        for name, motion in motions.items():
            kept = camera == name
            rows = kept[self.keyframe]
            until = motion.until_exposure(self.frame[self.keyframe[rows]], self.px[rows])
            delay[rows], turn[rows], shift[rows] = until.delay_s, until.turn, until.shift
            errors[kept] = motion.errors(self.frame[kept])
            interval_s[kept] = motion.interval_s
        seen = RowObservations(
            lenses=[self.lenses[name] for name in names],
            lens=np.searchsorted(names, camera),
            keyframe=self.keyframe,
            point=self.point,
            px=self.px,
            delay_s=delay,
            turn=turn,
            shift=shift,
            noise_px=noise_px,
            interval_s=interval_s,
            readout=np.array([readouts.number.get(name, 0) for name in self.camera], dtype=np.int64),
            informative=np.array([name not in self.uninformative for name in self.camera], dtype=bool),
            common_points=common_points,
        )
        return seen, np.maximum(errors, _NO_MOTION_SIGMA)

    def _systematic_errors(self, seen: RowObservations, readouts: _Readouts) -> FloatArray:
        """Return the errors (R,) of the readout times by systematic errors of detected pixels, seconds.

        They are large where the camera turns slowly, so that a readout time displaces pixels by little.
        """
        k = seen.keyframe[seen.informative_observations]
        focal = np.array([each.focal_px / pixel_scale(each.width_px, each.height_px) for each in seen.lenses])
        squares = (
            focal[seen.lens[k]] * np.linalg.norm(seen.turn[seen.informative_observations], axis=1)
        ) ** 2
        count, total = (
            np.bincount(seen.readout[k], each, len(readouts.seconds)) for each in (np.ones(len(k)), squares)
        )
        px = np.sqrt(total / np.maximum(count, 1.0))
        with np.errstate(divide="ignore"):
            return np.asarray(np.abs(readouts.scale_s) * _SYSTEMATIC_PX / px)

    def _uncertain(self, seen: RowObservations, readouts: _Readouts) -> BoolArray:
        """Return a mask (R,) of the readout times that were known better than they are determined here."""
        informative = np.unique(seen.keyframe[seen.informative_observations])
        keyframes = np.bincount(seen.readout[informative], minlength=len(readouts.seconds))
        unsure = self._systematic_errors(seen, readouts) > readouts.expected_s[:, 1]
        return np.asarray(unsure | (keyframes < _MIN_KEYFRAMES))

    def _after_pass(
        self,
        seen: RowObservations,
        found: RollingMap,
        errors: MotionErrors,
        readouts: _Readouts,
        width_px: float,
    ) -> _Readouts:
        """Return the readout times after a pass, with all their errors."""
        seconds = readouts.scale_s * found.readout_ratio
        parts = (
            np.abs(readouts.scale_s) * readout_errors(seen, found, errors, width_px),
            self._systematic_errors(seen, readouts),
            _COMMON_RATIO * correction_ratios(seen, found) * np.abs(seconds),
        )
        return readouts.after_pass(found.readout_ratio, np.linalg.norm(parts, axis=0))

    def _is_exact_enough(self, seen: RowObservations, errors: MotionErrors) -> bool:
        """Return True if the expected errors of velocities and readout times displace nothing by much."""
        focal_px = np.array([lens.focal_px for lens in seen.lenses])[seen.lens[seen.keyframe]]
        by_velocity = np.abs(seen.delay_s) * errors.rate[seen.keyframe]
        by_readout = np.linalg.norm(seen.turn, axis=1) * errors.readout[seen.readout[seen.keyframe]]
        expected_px = focal_px * np.hypot(by_velocity, by_readout)
        limit_px = _EXACT_RATIO * seen.noise_px
        return not len(expected_px) or bool(np.percentile(expected_px, _EXACT_PERCENT) < limit_px)

    def _moved_poses(self, name: str, cam_from_map: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return the poses of a camera's frames, moved with its keyframes, and their times.

        A frame between two keyframes gets a part of the changes of both, by its time. A frame before the
        first or after the last keyframe gets the change of this keyframe.

        Args:
            name: Name of the camera.
            cam_from_map: (K,4,4) poses of the keyframes.
        """
        poses, times_ns = self.poses[name]
        rows = np.flatnonzero(np.array(self.camera) == name)
        rows = rows[np.isfinite(poses[self.frame[rows]]).all(axis=(1, 2))]
        rows = rows[np.argsort(self.frame[rows])]
        if not len(rows):
            return poses, times_ns
        frames, new = self.frame[rows], invert(cam_from_map[rows])
        old = poses[frames]
        change = make_transform(
            new[:, :3, :3] @ np.swapaxes(old[:, :3, :3], 1, 2), new[:, :3, 3] - old[:, :3, 3]
        )
        every = np.arange(len(poses))
        after = np.minimum(np.searchsorted(frames, every), len(frames) - 1)
        before = np.maximum(np.searchsorted(frames, every, side="right") - 1, 0)
        span_ns = np.maximum(times_ns[frames[after]] - times_ns[frames[before]], 1)
        part = np.clip((times_ns - times_ns[frames[before]]) / span_ns, 0.0, 1.0)
        between = interpolate_pose(change[before], change[after], part)
        moved = make_transform(between[:, :3, :3] @ poses[:, :3, :3], between[:, :3, 3] + poses[:, :3, 3])
        return moved, times_ns

    def _error_scales(self, squares: FloatArray) -> FloatArray:
        """Return factors (K,3) of the expected errors of velocities.

        The errors of the keyframes of a camera have a Student distribution: each has its own size, near the
        usual size of the camera unless the pictures say otherwise. This is one step of an expectation
        maximisation in each pass. Where the pictures say nothing of a velocity, its correction is 0, its
        variance is what was expected, and the factor stays.

        Args:
            squares: (K,3) expected squares of the errors along an axis: squared correction and variance, in
                the expected errors of the path.

        Source: Lange, Little, Taylor, "Robust statistical modeling using the t distribution", 1989.
        """
        seen: BoolArray = np.bincount(self.keyframe, minlength=len(self.camera)) >= _MIN_OBSERVATIONS
        out, camera = np.full_like(squares, _FIRST_SCALE), np.array(self.camera)
        for name in np.unique(camera).tolist():
            own = np.flatnonzero(camera == name)
            if not seen[own].any():
                continue
            usual, weight = squares[own][seen[own]].mean(axis=0), np.ones((len(own), 3))
            for _ in range(_SCALE_STEPS):
                weight = (_FREEDOM + 3.0) / (_FREEDOM + 3.0 * squares[own] / usual)
                usual = np.maximum((weight * squares[own])[seen[own]].mean(axis=0), _MIN_SCALE**2)
            out[own] = np.sqrt(usual / weight)
        return out

    def _scales_of_frames(self, scales: FloatArray) -> dict[str, FloatArray]:
        """Return the factors (N,3) of all frames of each camera from those of the keyframes (K,3)."""
        out = {name: np.ones((len(times_ns), 3)) for name, (_, times_ns) in self.poses.items()}
        for name, frame, scale in zip(self.camera, self.frame.tolist(), scales, strict=True):
            if name in out:
                out[name][frame] = scale
        return out


def _motion_errors(velocities: FloatArray, readouts: _Readouts) -> MotionErrors:
    """Return expected errors.

    Args:
        velocities: (K,3) expected errors of angular velocity, its change and velocity.
        readouts: The readout times so far.
    """
    expected = readouts.expected_s / readouts.scale_s[:, None]
    return MotionErrors(
        rate=velocities[:, 0],
        rate_change=velocities[:, 1],
        velocity=velocities[:, 2],
        readout_ratio=expected[:, 0],
        readout=np.maximum(np.abs(expected[:, 1]), _NO_MOTION_SIGMA),
    )
