"""The rotation of a camera as its gyroscope measures it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, interpolated, set_array
from bodycap_batch.model.geometry import so3_exp, so3_log

_RATE_SAMPLES = 2.0
"""Time on each side of an instant, in intervals of the samples, over which its angular velocity is the mean.
Evidence: none."""

_GAUSS_POINTS = (0.5 - np.sqrt(3.0) / 6.0, 0.5 + np.sqrt(3.0) / 6.0)
"""Places of two angular velocities in an interval, as a share of it: those of Gauss and Legendre."""
_AXIS_CHANGE = np.sqrt(3.0) / 12.0
"""Factor of the product of these angular velocities in the Magnus expansion of fourth order."""


class GyroOrientation:
    """The orientation of a camera that its gyroscope alone gives, relative to the first sample.

    Args:
        times_s: (N,) times of the samples, seconds.
        rate_rad_s: (N,3) angular rates in the axes of the camera, rad/s.
    """

    def __init__(self, times_s: FloatArray, rate_rad_s: FloatArray) -> None:
        self.times_s, self._rate = times_s, rate_rad_s
        steps = 0.5 * (rate_rad_s[1:] + rate_rad_s[:-1]) * np.diff(times_s)[:, None]
        self.rotation = np.concatenate([np.eye(3)[None], so3_exp(steps)])
        shift = 1
        while shift < len(self.rotation):  # products of all steps before each sample, by doubling
            self.rotation[shift:] = self.rotation[:-shift] @ self.rotation[shift:]
            shift *= 2

    def at(self, times_s: FloatArray) -> FloatArray:
        """Return the rotations (T,3,3) at times (T,), seconds. Outside the samples, the rate is constant."""
        before = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 2)
        step_s = times_s - self.times_s[before]
        slope = np.diff(self._rate, axis=0)[before] / np.diff(self.times_s)[before, None]
        inside = np.clip(step_s, 0.0, np.diff(self.times_s)[before])[:, None]
        turned = self._rate[before] * step_s[:, None] + 0.5 * slope * inside**2
        return np.asarray(self.rotation[before] @ so3_exp(turned))


@dataclass(frozen=True, slots=True, kw_only=True)
class GyroRates:
    """Angular velocities of a camera from its gyroscope, in the axes and on the clock of the camera.

    Attributes:
        times_s: (S,) time of each sample on the clock of the camera's frames, seconds, increasing.
        rate_rad_s: (S,3) angular velocity in the axes of the camera, without the estimated bias, rad/s.
        gaps_s: (G,2) start and end of each stretch without samples, seconds.
        readout_s: Readout time (seconds) that was estimated together with the delay of the samples; NaN if
            it was not.
        readout_sigma_s: Its standard deviation, seconds.
    """

    times_s: FloatArray
    rate_rad_s: FloatArray
    gaps_s: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    readout_s: float = float("nan")
    readout_sigma_s: float = float("inf")

    def __post_init__(self) -> None:
        set_array(self, "times_s", (None,))
        set_array(self, "rate_rad_s", (len(self.times_s), 3))
        set_array(self, "gaps_s", (None, 2))
        if len(self.times_s) < 2 or (np.diff(self.times_s) <= 0.0).any():
            raise ValueError("times_s: at least two increasing times are necessary")

    def covers(self, start_s: FloatArray, end_s: FloatArray) -> BoolArray:
        """Return for each interval (N,) whether samples without a gap cover it."""
        inside = (start_s >= self.times_s[0]) & (end_s <= self.times_s[-1])
        for first_s, last_s in self.gaps_s:
            inside &= (end_s <= first_s) | (start_s >= last_s)
        return np.asarray(inside)

    def orientation(self) -> GyroOrientation:
        """Return the orientation relative to the first sample."""
        return GyroOrientation(self.times_s, self.rate_rad_s)

    def at_frames(self, times_ns: IntArray) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return the rotation from frame to frame, and the angular velocity of each frame.

        Args:
            times_ns: (N,) frame times, nanoseconds.

        Returns:
            Rotations (N-1,3,3) later_from_earlier, a mask (N-1,) of those that samples cover, and angular
            velocities (N,3) in the axes of the camera, rad/s.
        """
        seconds: FloatArray = np.asarray(times_ns * 1e-9, dtype=np.float64)
        oriented = self.orientation()
        rotation = oriented.at(seconds)
        step = np.swapaxes(rotation[1:], 1, 2) @ rotation[:-1]
        span_s = _RATE_SAMPLES * float(np.median(np.diff(self.times_s)))
        before, after = oriented.at(seconds - span_s), oriented.at(seconds + span_s)
        rate = so3_log(np.swapaxes(before, 1, 2) @ after).reshape(-1, 3) / (2.0 * span_s)
        return step, self.covers(seconds[:-1], seconds[1:]), rate

    def rotvec_between(self, start_s: FloatArray, delay_s: FloatArray) -> FloatArray:
        """Return the rotation vectors (M,3) of the camera over short times, radians.

        Args:
            start_s: (M,) start of each rotation, seconds.
            delay_s: (M,) time from the start to the end, seconds; it may be negative.

        Source: Iserles, Nørsett, "On the solution of linear differential equations in Lie groups", 1999, for
            the term that the change of the axis adds: the Magnus expansion of fourth order.
        """
        steps = 0.5 * (self.rate_rad_s[1:] + self.rate_rad_s[:-1]) * np.diff(self.times_s)[:, None]
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        plain = self._integral(total, start_s + delay_s) - self._integral(total, start_s)
        early, late = (
            interpolated(start_s + share * delay_s, self.times_s, self.rate_rad_s) for share in _GAUSS_POINTS
        )
        return np.asarray(plain + _AXIS_CHANGE * (delay_s**2)[:, None] * np.cross(early, late))

    def _integral(self, total: FloatArray, times_s: FloatArray) -> FloatArray:
        """Return integrals (M,3) of the rate from the first sample; (S,3) `total` holds those of samples."""
        before = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 2)
        step_s = (times_s - self.times_s[before])[:, None]
        mean = 0.5 * (self.rate_rad_s[before] + interpolated(times_s, self.times_s, self.rate_rad_s))
        return np.asarray(total[before] + mean * step_s)
