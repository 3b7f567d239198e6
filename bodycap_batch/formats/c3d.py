"""C3D files: joint centres as labelled points in millimetres, in world axes (Z up, facing −Y)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, set_array
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.model.take import Take

MM_PER_M = 1000.0
"""Millimetres per metre."""

_INVALID = -1.0
"""Residual of an invalid point. Source: the C3D file format user guide, "Invalid 3D point data"."""

_RESIDUAL_RANGE_MM = (1.0, 127.0)
"""Least and largest residual of a measured point, millimetres. Source: the same guide: a residual has eight
bits with a sign, and 0 marks an interpolated point."""

_TOLERANCE_M = 1e-5
"""Maximum difference, metres, between a coordinate that is read back and the coordinate that was written.
Derivation: the format stores single-precision numbers. Their rounding error is 1 µm at a distance of 10 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledPoints:
    """The positions of N labelled points in the world at T times.

    Attributes:
        names: (N,) labels of the points.
        fps: Frames per second.
        x_in_world_m: (T,N,3) positions of the points in the world, metres; NaN for a point that was read
            from a file and is not measured.
        measured: (N,) False for a point that no camera measured; None if all points are measured.
        observed: (T,N) False at a time at which only neighbouring times determine the point; None if this is
            unknown.
        sigma_m: (T,N) standard deviation per axis of each point, metres, NaN if it is unknown; None if all
            are unknown.
    """

    names: tuple[str, ...]
    fps: float
    x_in_world_m: FloatArray
    measured: BoolArray | None = None
    observed: BoolArray | None = None
    sigma_m: FloatArray | None = None

    def __post_init__(self) -> None:
        set_array(self, "x_in_world_m", (None, len(self.names), 3), finite=False)
        if self.measured is not None:
            set_array(self, "measured", (len(self.names),), np.bool_)
        shape = self.x_in_world_m.shape[:2]
        if self.observed is not None:
            set_array(self, "observed", shape, np.bool_)
        if self.sigma_m is not None:
            set_array(self, "sigma_m", shape, finite=False)

    def measured_points(self) -> BoolArray:
        """Return (N,) whether each point is measured."""
        return np.ones(len(self.names), dtype=bool) if self.measured is None else self.measured


def write_c3d(path: Path, points: LabelledPoints, take: Take | None = None) -> Path:
    """Write points as a C3D file, read the file back and compare the measured points.

    The residual of a point that is not measured is −1, which marks the point as invalid. Where a measured
    point is observed, the residual is its standard deviation in whole millimetres, 1 to 127. Elsewhere it is
    0, which marks an interpolated point. The parameter group BODYCAP holds the take, the exact rate and the
    start timecode, for which the format has no place.

    Args:
        path: Path of the file, which is replaced atomically.
        points: The points.
        take: Name, exact rate and timecode; None if they are unknown.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written, or the points that are read back differ from the given points.
    """
    import ezc3d

    content = ezc3d.c3d()
    group = content["parameters"]["POINT"]
    group["RATE"]["value"] = [points.fps]
    group["LABELS"]["value"] = list(points.names)
    group["UNITS"]["value"] = ["mm"]
    content.add_parameter("POINT", "X_SCREEN", ["+X"])
    content.add_parameter("POINT", "Y_SCREEN", ["+Z"])
    frames, count = points.x_in_world_m.shape[:2]
    data = np.ones((4, count, frames))
    data[:3] = MM_PER_M * points.x_in_world_m.transpose(2, 1, 0)
    content["data"]["points"] = data
    content["data"]["meta_points"]["residuals"] = _residuals(points)[None]
    facts = {} if take is None else take.figures()
    for key, name in (("take", "TAKE"), ("rate", "RATE"), ("start_timecode", "START_TIMECODE")):
        if key in facts:
            content.add_parameter("BODYCAP", name, [str(facts[key])])
    with atomic_replacement(path) as temporary:
        content.write(str(temporary))
        back = read_c3d(temporary)
        same = back.names == points.names and back.x_in_world_m.shape == points.x_in_world_m.shape
        kept = points.measured_points()
        if not same or _differ(back.x_in_world_m[:, kept], points.x_in_world_m[:, kept]):
            raise StoreError(
                "the points in the written file differ from the solved points",
                path=path,
                hint="check that the disk is not full",
            )
    return path


def _residuals(points: LabelledPoints) -> FloatArray:
    """Return the residuals (N,T) of points, millimetres: see `write_c3d`."""
    out = np.zeros(points.x_in_world_m.shape[:2])
    if points.sigma_m is not None:
        known = np.isfinite(points.sigma_m)
        out[known] = np.clip(np.round(MM_PER_M * points.sigma_m[known]), *_RESIDUAL_RANGE_MM)
    if points.observed is not None:
        out[~points.observed] = 0.0
    out[:, ~points.measured_points()] = _INVALID
    return np.asarray(out.T)


def _differ(back: FloatArray, written: FloatArray) -> bool:
    """Return True if points that were read back differ by more than the tolerance, or are not numbers."""
    return not bool((np.abs(back - written) <= _TOLERANCE_M).all())


def read_c3d(path: Path) -> LabelledPoints:
    """Read the points of a C3D file whose unit is the millimetre.

    Raises:
        JobError: The file is missing, or it is not a C3D file.
    """
    import ezc3d

    try:
        content = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError) as error:
        raise JobError(
            f"the file cannot be read as C3D: {error}",
            path=path,
            hint="run the job again to write a new file",
        ) from error
    group = content["parameters"]["POINT"]
    residuals = content["data"]["meta_points"]["residuals"][0]
    return LabelledPoints(
        names=tuple(group["LABELS"]["value"]),
        fps=float(group["RATE"]["value"][0]),
        x_in_world_m=content["data"]["points"][:3].transpose(2, 1, 0) / MM_PER_M,
        measured=~(residuals < 0.0).all(axis=1),
    )
