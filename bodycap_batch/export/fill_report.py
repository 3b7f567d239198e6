"""Write ``fill.json``: which joints no camera measured, how they were posed, and when the feet stand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, true_spans
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.model.fill_data import SIDES, FillReport
from bodycap_batch.model.merge_data import MergeResult

FILL_FILE = "fill.json"
"""Name of the file."""


def write_fill_report(path: Path, merge: MergeResult) -> Path:
    """Write the file and return its path.

    Args:
        path: Path of the file to write.
        merge: The motion, after the stage `fill`.

    Raises:
        StoreError: The file cannot be written.
    """
    write_text(path, json.dumps(fill_content(merge), indent=1, ensure_ascii=False) + "\n")
    return path


def fill_content(merge: MergeResult) -> dict[str, Any]:
    """Return what the stage `fill` did, as plain JSON values; empty before this stage.

    Times are common times in seconds, lengths in metres, angles in degrees.
    """
    fill = merge.fill
    if fill is None:
        return {}
    skeleton = merge.skeleton
    return {
        "mode": fill.mode,
        "measured_joints": [skeleton.joints[joint] for joint in np.flatnonzero(merge.solved)],
        "filled_joints": [skeleton.joints[joint] for joint in np.flatnonzero(fill.filled)],
        "rest_joints": [skeleton.joints[joint] for joint in np.flatnonzero(~merge.solved & ~fill.filled)],
        "floor": {
            "height_m": round(fill.floor_m, 4),
            "sigma_m": round(fill.floor_sigma_m, 4),
            "source": fill.floor_source,
        },
        "unsure_s": _spans(merge, ~fill.is_sure) if fill.filled.any() else [],
        "footsteps": _footsteps(merge, fill),
    }


def _footsteps(merge: MergeResult, fill: FillReport) -> list[dict[str, Any]]:
    steps = fill.footsteps
    return [
        {
            "foot": SIDES[int(steps.side[index])].lower(),
            "start_s": _seconds(merge, int(steps.start_tick[index])),
            "end_s": _seconds(merge, int(steps.end_tick[index])),
            "ankle_in_world_m": steps.ankle_in_world_m[index].round(4).tolist(),
            "heading_deg": round(float(np.degrees(steps.heading_rad[index])), 2),
            "sure": bool(steps.is_sure[index]),
        }
        for index in range(len(steps.side))
    ]


def _spans(merge: MergeResult, mask: BoolArray) -> list[list[float]]:
    """Return the start and the end of each period in which a mask (T,) is True."""
    return [[_seconds(merge, start), _seconds(merge, end + 1)] for start, end in true_spans(mask)]


def _seconds(merge: MergeResult, tick: int) -> float:
    return round(merge.start_ns * 1e-9 + tick / merge.fps, 6)
