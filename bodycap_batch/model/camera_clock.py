"""The relation between the timestamps of a camera and the common clock of a capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray

ClockSource = Literal["sound", "motion", "stated", "common", "none"]
"""What determined a clock. ``motion``: the solved paths. ``stated``: the
job or the calibration file. ``common``: the reference camera, and cameras that share its clock. ``none``:
nothing, so the clock is unknown."""


ESTIMATED_SOURCES: tuple[ClockSource, ...] = ("sound", "motion")
"""Sources of clocks that are estimated and have a standard deviation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTiming:
    """The timing of a camera's frames that does not depend on its clock.

    Attributes:
        nominal_fps: Nominal frame rate of the camera, frames per second. Dropped frames do not change the
            nominal frame rate.
        rolling_shutter_s: Seconds from the exposure of the first image row to the exposure of the last row.
    """

    nominal_fps: float
    rolling_shutter_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockRelation:
    """The clock of one camera: common time = camera time · (1 + drift_ppm · 1e-6) + offset_s.

    Attributes:
        offset_s: Offset at camera time 0, seconds; 0 if it is unknown.
        sigma_s: Standard deviation of the offset, seconds.
        drift_ppm: Drift, parts per million; 0 if it was not measured.
        drift_sigma_ppm: Standard deviation of the drift.
        correlation: Correlation of the errors of offset and drift, -1 to 1.
        source: What determined the clock.
        notes: Why the clock is unknown, and what contradicts it, as sentences for the user.
        is_contradicted: True if another source contradicts the clock.
    """

    offset_s: float = 0.0
    sigma_s: float = 0.0
    drift_ppm: float = 0.0
    drift_sigma_ppm: float = 0.0
    correlation: float = 0.0
    source: ClockSource = "common"
    notes: tuple[str, ...] = ()
    is_contradicted: bool = False

    @property
    def is_known(self) -> bool:
        """True if the offset is known."""
        return self.source != "none"

    def values(self) -> dict[str, Any]:
        """Return the fields of a relation, without those of a derived class, by name."""
        return {each.name: getattr(self, each.name) for each in fields(ClockRelation)}

    def sigma_at(self, camera_s: float) -> float:
        """Return the standard deviation of the common time at a camera time, seconds.

        Args:
            camera_s: Time on the camera's clock, seconds.
        """
        drift_s = 1e-6 * camera_s * self.drift_sigma_ppm
        variance = self.sigma_s**2 + 2.0 * self.correlation * self.sigma_s * drift_s + drift_s**2
        return float(np.sqrt(max(variance, 0.0)))

    def common_ns(self, times_ns: IntArray, later_s: FloatArray | float = 0.0) -> IntArray:
        """Return the common time (N,), nanoseconds, of instants on the camera's clock.

        Args:
            times_ns: (N,) camera times, nanoseconds.
            later_s: (N,) seconds from each of these times to the instant.
        """
        # In float64, the drift of a Unix time, which is hours, is exact to less than a nanosecond.
        shift_s = np.full(len(times_ns), self.offset_s) + later_s + 1e-15 * self.drift_ppm * times_ns
        return np.asarray(times_ns + np.round(shift_s * 1e9), dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraClock(ClockRelation):
    """The timing of a camera's frames and their relation to the common clock.

    Attributes:
        nominal_fps: Nominal frame rate of the camera, frames per second. Dropped frames do not change the
            nominal frame rate.
        rolling_shutter_s: Seconds from the exposure of the first image row to the exposure of the last row.
    """

    nominal_fps: float
    rolling_shutter_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.nominal_fps > 0.0:
            raise ValueError(f"nominal_fps must be positive, not {self.nominal_fps}")

    def common_times_ns(self, times_ns: IntArray, row_fraction: FloatArray | None = None) -> IntArray:
        """Return the common time (N,), nanoseconds, at which the pose of each frame is valid.

        Args:
            times_ns: (N,) camera time of each frame, nanoseconds. The middle row is exposed at this time.
            row_fraction: (N,) mean image row of the observations that each pose was estimated from, as a
                fraction of the image height. The pose is valid at the exposure of this row. None if each pose
                is valid at the exposure of the middle row.
        """
        if row_fraction is None:
            return self.common_ns(times_ns)
        return self.common_ns(times_ns, (row_fraction - 0.5) * self.rolling_shutter_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureClocks:
    """The clocks of all cameras of a capture.

    Attributes:
        reference: Name of the reference camera. Offsets are reported relative to this camera.
        cameras: The clock of each camera, by camera name.
    """

    reference: str
    cameras: Mapping[str, ClockRelation] = field(default_factory=dict)

    def with_timing(self, timings: Mapping[str, FrameTiming]) -> dict[str, CameraClock]:
        """Return the clocks of the cameras with a known frame timing, by camera name."""
        return {
            name: CameraClock(**asdict(timing), **self.cameras.get(name, ClockRelation()).values())
            for name, timing in timings.items()
        }
