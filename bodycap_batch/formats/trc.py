"""TRC files, the marker format of OpenSim: joint centres in millimetres, X forward, Y up, Z to the right."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.c3d import LabelledPoints

_FILE_FROM_WORLD: FloatArray = frozen_array(
    [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], name="file_from_world", shape=(3, 3)
)
"""Rotation from world axes (Z up, facing −Y, left +X) to file axes (X forward, Y up, Z to the right)."""

_MM_PER_M = 1000.0
"""Millimetres per metre."""


def write_trc(path: Path, points: LabelledPoints) -> Path:
    """Write points as a TRC file.

    The times in the file start at 0. The coordinates have three decimals, so the resolution is one
    micrometre. The coordinates of a point that is not measured are blank.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    rate, frames, count = f"{points.fps:g}", len(points.x_in_world_m), len(points.names)
    names = [" ".join(name.split()) for name in points.names]
    axes = "\t".join(f"{axis}{number}" for number in range(1, count + 1) for axis in "XYZ")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{count}\tmm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    table = (_MM_PER_M * points.x_in_world_m @ _FILE_FROM_WORLD.T + 0.0).reshape(frames, 3 * count)
    cell = np.where(np.repeat(points.measured_points(), 3), "\t%.3f", "\t%.0s")
    row = "%d\t%.6f" + "".join(cell.tolist())
    seconds = np.arange(frames) / points.fps
    lines += [row % (index + 1, seconds[index], *values) for index, values in enumerate(table)]
    write_text(path, "\n".join(lines) + "\n")
    return path
