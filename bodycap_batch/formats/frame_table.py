"""The table ``frames.csv``: the status of every frame of every camera."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import encoding_of_file
from bodycap_batch.formats.tum import nanoseconds
from bodycap_batch.model.scene import FrameStatus

COLUMNS = (
    "camera",
    "frame",
    "time",
    "common_time",
    "status",
    "reason",
    "inliers",
    "error",
    "map",
    "sigma_position",
    "sigma_rotation_deg",
)
LOST = "LOST"
"""Value of the column `status` of a frame without a pose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTable:
    """The frames of one camera, in the order of the video.

    Attributes:
        camera: Name of the camera.
        frame_numbers: (N,) number of each frame in the camera's videos, counted from 0.
        times_ns: (N,) time of each frame on the camera's own clock, nanoseconds.
        common_times_ns: (N,) the same times on the common clock of all cameras.
        status: (N,) status of each frame: localised, or the reason why the frame is lost.
        inliers: (N,) number of map points that agree with the pose.
        error_px: (N,) reprojection error of the measured pose, pixels at the work size; NaN without a pose.
        map_numbers: (N,) number of the map to which the pose of each frame refers: 0 is ``map.ply``, n is
            ``map_<n>.ply``; -1 without a pose, and in results of earlier versions. A lost frame with the
            status OTHER_MAP has a pose in another map, in ``trajectories/map_<n>/<camera>.tum``.
        sigma_position: (N,) standard deviation per axis of the measured camera centre: metres in the world,
            units of the map without a world. NaN without a pose, and in results of earlier versions, whose
            tables lack this column.
        sigma_rotation_deg: (N,) standard deviation per axis of the measured orientation, degrees; NaN as
            `sigma_position`.
    """

    camera: str
    frame_numbers: IntArray
    times_ns: IntArray
    common_times_ns: IntArray
    status: tuple[FrameStatus, ...]
    inliers: IntArray
    error_px: FloatArray
    map_numbers: IntArray
    sigma_position: FloatArray
    sigma_rotation_deg: FloatArray

    def __post_init__(self) -> None:
        count = len(self.status)
        for name in ("frame_numbers", "times_ns", "common_times_ns", "inliers", "map_numbers"):
            set_array(self, name, (count,), np.int64)
        for name in ("error_px", "sigma_position", "sigma_rotation_deg"):
            set_array(self, name, (count,), finite=False)

    @property
    def localised(self) -> BoolArray:
        """Mask (N,) of the frames with a pose."""
        return np.array([status.localised for status in self.status], dtype=bool)

    @property
    def rotation_only(self) -> BoolArray:
        """Mask (N,) of the frames with a rotation and no position."""
        return np.array([status is FrameStatus.ROTATION_ONLY for status in self.status], dtype=bool)

    @property
    def times_s(self) -> FloatArray:
        """Time (N,) of each frame on the camera's own clock, seconds."""
        return np.asarray(self.times_ns * 1e-9)


def read_frame_table(path: Path) -> dict[str, FrameTable]:
    """Read the frames of each camera from a file ``frames.csv``.

    Returns:
        The frames by the name of the camera, in the order of the file.

    Raises:
        JobError: The file is missing or malformed.
    """
    columns: dict[str, list[dict[str, str]]] = defaultdict(list)
    try:
        with path.open(newline="", encoding=encoding_of_file(path)) as stream:
            for row in csv.DictReader(line for line in stream if not line.startswith("#")):
                columns[row["camera"]].append(row)
        return {camera: _table(camera, rows) for camera, rows in columns.items()}
    except FileNotFoundError:
        raise JobError(
            "the results hold no table of the frames",
            path=path,
            hint="add csv to export.formats in the job file, and run the job again",
        ) from None
    except (OSError, KeyError, ValueError, TypeError, ArithmeticError) as error:
        raise JobError(
            f"the table of the frames cannot be read: {error}", path=path, hint="run the job again"
        ) from error


def _table(camera: str, rows: list[dict[str, str]]) -> FrameTable:
    def numbers(column: str) -> FloatArray:
        return np.array([float(row.get(column) or "nan") for row in rows])

    return FrameTable(
        camera=camera,
        frame_numbers=np.array([int(row["frame"]) for row in rows]),
        times_ns=np.array([nanoseconds(row["time"]) for row in rows]),
        common_times_ns=np.array([nanoseconds(row["common_time"]) for row in rows]),
        status=tuple(FrameStatus(row["reason"] if row["status"] == LOST else row["status"]) for row in rows),
        inliers=np.array([int(row["inliers"]) for row in rows]),
        error_px=numbers("error"),
        map_numbers=np.array([int(row.get("map") or -1) for row in rows]),
        sigma_position=numbers("sigma_position"),
        sigma_rotation_deg=numbers("sigma_rotation_deg"),
    )
