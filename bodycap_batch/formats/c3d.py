"""C3D files: joint centres as labelled points in millimetres, in world axes (Z up, facing −Y)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, set_array
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.atomic_files import atomic_replacement

_MM_PER_M = 1000.0
"""Millimetres per metre."""

_TOLERANCE_M = 1e-5
"""Maximum difference, metres, between a coordinate that is read back and the coordinate that was written.
Derivation: the format stores single-precision numbers. Their rounding error is 1 µm at a distance of 10 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledPoints:
    """The positions of N labelled points in the world at T times.

    Attributes:
        names: (N,) labels of the points.
        fps: Frames per second.
        x_in_world_m: (T,N,3) positions of the points in the world, metres.
    """

    names: tuple[str, ...]
    fps: float
    x_in_world_m: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "x_in_world_m", (None, len(self.names), 3))


def write_c3d(path: Path, points: LabelledPoints) -> Path:
    """Write points as a C3D file, read the file back and compare the points.

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
    data[:3] = _MM_PER_M * points.x_in_world_m.transpose(2, 1, 0)
    content["data"]["points"] = data
    with atomic_replacement(path) as temporary:
        content.write(str(temporary))
        back = read_c3d(temporary)
        same = back.names == points.names and back.x_in_world_m.shape == points.x_in_world_m.shape
        if not same or np.abs(back.x_in_world_m - points.x_in_world_m).max(initial=0.0) > _TOLERANCE_M:
            raise StoreError(
                "the points in the written file differ from the solved points",
                path=path,
                hint="check that the disk is not full",
            )
    return path


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
    return LabelledPoints(
        names=tuple(group["LABELS"]["value"]),
        fps=float(group["RATE"]["value"][0]),
        x_in_world_m=content["data"]["points"][:3].transpose(2, 1, 0) / _MM_PER_M,
    )
