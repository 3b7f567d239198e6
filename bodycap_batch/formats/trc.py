"""TRC files, the marker format of OpenSim: joint centres in millimetres, X forward, Y up, Z to the right."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, frozen_array
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.c3d import MM_PER_M, LabelledPoints

_FILE_FROM_WORLD: FloatArray = frozen_array(
    [[0, -1, 0], [0, 0, 1], [-1, 0, 0]], name="file_from_world", shape=(3, 3)
)
"""Rotation from world axes (Z up, facing −Y, left +X) to file axes (X forward, Y up, Z to the right)."""


def write_trc(path: Path, points: LabelledPoints) -> Path:
    """Write points as a TRC file.

    The times in the file start at 0. The coordinates have three decimals, so the resolution is one
    micrometre. A point that is not measured is left out: readers that split rows at white space would take
    blank cells for the coordinates of the next point.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    measured = points.measured_points()
    names = [" ".join(name.split()) for name, kept in zip(points.names, measured, strict=True) if kept]
    rate, frames, count = f"{points.fps:.10g}", len(points.x_in_world_m), len(names)
    axes = "\t".join(f"{axis}{number}" for number in range(1, count + 1) for axis in "XYZ")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{count}\tmm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    centres = points.x_in_world_m[:, measured]
    table = (MM_PER_M * centres @ _FILE_FROM_WORLD.T + 0.0).reshape(frames, 3 * count)
    row = "%d\t%.6f" + 3 * count * "\t%.3f"
    seconds = np.arange(frames) / points.fps
    lines += [row % (index + 1, seconds[index], *values) for index, values in enumerate(table)]
    write_text(path, "\n".join(lines) + "\n")
    return path
