"""Write ``frames.csv``: the status of every frame of every camera."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.target_frames import target_numbers, trajectories_in_target_frames
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.frame_table import COLUMNS, LOST
from bodycap_batch.formats.tum import seconds_text
from bodycap_batch.model.scene import FrameStatus, Trajectory


def write_frame_table(path: Path, inputs: ExportInputs) -> Path:
    """Write one line for each frame of each camera, and return the path of the file.

    Times are in seconds. Errors are in pixels at the work size (the image size that all stages work at). The
    column `status` is KEYFRAME, REGISTERED, INERTIAL, ROTATION_ONLY or LOST. INERTIAL means that the pose was
    derived from the inertial sensor, and ROTATION_ONLY that the frame has no position. For a lost frame, the
    column `reason` holds the value of `FrameStatus`.

    The column `map` is the number of the map to which the pose refers, as in the names ``map_<n>.ply``; 0 is
    ``map.ply``. A lost frame with a pose in another map than that of the camera's path has the reason
    OTHER_MAP and the number of this map.

    The sigmas are those of the pose as measured, per axis: the centre in metres, or in units of the map
    without a world; the rotation in degrees.

    Args:
        path: Path of the file to write.
        inputs: The results of the earlier stages.

    Raises:
        StoreError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    numbers = target_numbers(inputs)
    for trajectory in trajectories_in_target_frames(inputs):
        map_numbers = _map_numbers(trajectory, inputs.other_paths, numbers)
        common = inputs.clocks[trajectory.camera].common_times_ns(trajectory.times_ns)
        sigma_position, sigma_rotation_deg = _sigmas(trajectory)
        for index, status in enumerate(trajectory.status):
            writer.writerow(
                (
                    trajectory.camera,
                    int(trajectory.frame_numbers[index]),
                    seconds_text(int(trajectory.times_ns[index])),
                    seconds_text(int(common[index])),
                    *_status_and_reason(status),
                    int(trajectory.inliers[index]),
                    _number_text(trajectory.error_px[index], 3),
                    map_numbers.get(int(trajectory.frame_numbers[index]), ""),
                    _number_text(sigma_position[index], 6),
                    _number_text(sigma_rotation_deg[index], 6),
                )
            )
    write_text(path, text.getvalue())
    return path


def _map_numbers(
    path: Trajectory, other_paths: Sequence[Trajectory], numbers: Mapping[str, int]
) -> dict[int, int]:
    """Return the number of the map to which the pose of each frame of a camera refers, by frame number."""
    parts = (path, *(other for other in other_paths if other.camera == path.camera))
    return {
        int(frame): numbers[part.gauge]
        for part in parts
        for frame in part.frame_numbers[part.localised]
        if part.gauge in numbers
    }


def _number_text(value: float, decimals: int) -> str:
    """Return a number with these decimals; "" for NaN."""
    return f"{value:.{decimals}f}" if np.isfinite(value) else ""


def _sigmas(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return the sigmas per axis of the centre and of the rotation (degrees) of each frame; NaN: lost."""
    variance = np.diagonal(trajectory.covariance, axis1=1, axis2=2)
    rotation_rad, position = (np.sqrt(variance[:, part].mean(axis=1)) for part in (slice(3), slice(3, 6)))
    return position, np.degrees(rotation_rad)


def _status_and_reason(status: FrameStatus) -> tuple[str, str]:
    """Return the values of the columns `status` and `reason`."""
    is_measured = status.localised or status is FrameStatus.ROTATION_ONLY
    return (status.value, "") if is_measured else (LOST, status.value)
