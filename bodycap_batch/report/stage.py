"""From a job's results to ``report.html``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.context import StageContext
from bodycap_batch.errors import StoreError
from bodycap_batch.formats.files import write_text
from bodycap_batch.report.content import page_content
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.lost import lost_frames
from bodycap_batch.report.marks import Marks
from bodycap_batch.report.packing import Shown
from bodycap_batch.report.page import render
from bodycap_batch.report.pictures import SERIES_BUDGET, series
from bodycap_batch.report.placing import common_times_s, place
from bodycap_batch.report.solid import solid_data

REPORT_FILE = "report.html"
MAX_BYTES = 15_000_000
_TONES = ("#c8503c", "#14808f", "#c98b1a", "#7a5ba8", "#4c8a45", "#b4508a", "#5773b8", "#8a6a45")


def write_report(inputs: ReportInputs, path: Path, context: StageContext) -> None:
    """Write the page: everything in one file, at most 15 MB at any length.

    Args:
        inputs: The results, as far as the job came.
        path: The file to write.
        context: Progress and cancelling.

    Raises:
        StoreError: The file cannot be written, or grew beyond its limit.
    """
    shown = Shown()
    placed = place(inputs)
    tones = {name: _TONES[index % len(_TONES)] for index, name in enumerate(inputs.cameras)}
    context.progress(0, 3, "pictures")
    lost = lost_frames(inputs, context)
    data = {
        "name": inputs.name,
        "tones": tones,
        "solid": solid_data(inputs, placed, shown),
        "pictures": _pictures(inputs, shown, context) if placed.drawn else [],
    }
    context.progress(1, 3, "figures")
    content = page_content(inputs, placed, lost, tones, shown)
    context.progress(2, 3, "page")
    text = render(content, {**data, "shown": shown.document()})
    size = len(text.encode("utf-8"))
    if size > MAX_BYTES:
        raise StoreError(
            f"the report would have {size / 1e6:.1f} MB", path=path, hint="please report this job as a bug"
        )
    write_text(path, text)
    context.progress(3, 3, "")


def _pictures(inputs: ReportInputs, shown: Shown, context: StageContext) -> list[dict[str, Any]]:
    """The picture series of every camera with what is drawn over each picture."""
    if inputs.capture is None:
        return []
    marks, out = Marks(inputs), []
    for name in inputs.cameras:
        camera = inputs.capture.camera(name)
        times = common_times_s(inputs, name, camera.times_ns)
        budget = SERIES_BUDGET // len(inputs.cameras)
        pictures = series(camera, times, budget, context)
        shown.note("video frames as pictures", len(pictures), len(camera.frame_numbers))
        out.append(
            {
                "camera": name,
                "size": [camera.camera.width_px, camera.camera.height_px],
                "count": len(camera.frame_numbers),
                "frames": [
                    {
                        "t": round(float(times[picture.index]), 6),
                        "jpeg": picture.jpeg,
                        **_frame(inputs, name, picture.index),
                        **mark,
                    }
                    for picture, mark in zip(pictures, marks.over(name, pictures), strict=True)
                ],
            }
        )
    return out


def _frame(inputs: ReportInputs, name: str, index: int) -> dict[str, Any]:
    """What is known of one frame."""
    path = inputs.path(name)
    if path is None:
        return {"i": index, "status": "", "inliers": 0, "error": None}
    error = float(path.error_px[index])
    return {
        "i": index,
        "status": path.status[index].value,
        "inliers": int(path.inliers[index]),
        "error": round(error, 3) if np.isfinite(error) else None,
    }
