"""Write ``frames.csv``: the status of every frame of every camera."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.target_frames import trajectories_in_target_frames
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.tum import seconds_text
from bodycap_batch.model.scene import FrameStatus

COLUMNS = ("camera", "frame", "time", "common_time", "status", "reason", "inliers", "error")
LOST = "LOST"


def write_frame_table(path: Path, inputs: ExportInputs) -> Path:
    """Write one line for each frame of each camera, and return the path of the file.

    Times are in seconds. Errors are in pixels at the work size (the image size that all stages work at). The
    column `status` is KEYFRAME, REGISTERED, INERTIAL or LOST. INERTIAL means that the pose was derived
    from the inertial sensor. For a lost frame, the
    column `reason` holds the value of `FrameStatus`.

    Args:
        path: Path of the file to write.
        inputs: The results of the earlier stages.

    Raises:
        StoreError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for trajectory in trajectories_in_target_frames(inputs):
        common = inputs.clocks[trajectory.camera].common_times_ns(trajectory.times_ns)
        for index, status in enumerate(trajectory.status):
            error = trajectory.error_px[index]
            writer.writerow(
                (
                    trajectory.camera,
                    int(trajectory.frame_numbers[index]),
                    seconds_text(int(trajectory.times_ns[index])),
                    seconds_text(int(common[index])),
                    *_status_and_reason(status),
                    int(trajectory.inliers[index]),
                    f"{error:.3f}" if np.isfinite(error) else "",
                )
            )
    write_text(path, text.getvalue())
    return path


def _status_and_reason(status: FrameStatus) -> tuple[str, str]:
    """Return the values of the columns `status` and `reason`."""
    return (status.value, "") if status.localised else (LOST, status.value)
