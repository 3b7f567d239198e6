"""From a job's results to ``report.html``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.palette import camera_colours, hex_from_colour
from bodycap_batch.report.content import page_content
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.lost import lost_frames
from bodycap_batch.report.marks import Marks
from bodycap_batch.report.packing import Shown, thinned
from bodycap_batch.report.page import render
from bodycap_batch.report.pictures import SERIES_BUDGET, series
from bodycap_batch.report.placing import common_times_s, place
from bodycap_batch.report.solid import solid_data

REPORT_FILE = "report.html"
MAX_BYTES = 15_000_000
_SHARES = (1.0, *(0.6**step for step in range(1, 16)))
"""Of every budget, one after the other; at the last one hardly more than words and tables is left."""


def write_report(inputs: ReportInputs, path: Path, context: StageContext) -> None:
    """Write the page: everything in one file, at most 15 MB at any length.

    What would be too large is drawn again with smaller budgets until it fits; the page says what was thinned.

    Args:
        inputs: The results, as far as the job came.
        path: The file to write.
        context: Progress and cancelling.

    Raises:
        StoreError: The file cannot be written.
    """
    placed = place(inputs)
    tones = {name: hex_from_colour(colour) for name, colour in camera_colours(inputs.cameras).items()}
    context.progress(0, 3, "pictures")
    lost = lost_frames(inputs, context)
    pictures = _pictures(inputs, context) if placed.drawn else []
    context.progress(1, 3, "figures")
    for share in _SHARES:
        context.check_cancelled()
        shown = Shown(share=share)
        data = {
            "name": inputs.name,
            "tones": tones,
            "solid": solid_data(inputs, placed, shown),
            "pictures": [_fewer(each, shown) for each in pictures],
        }
        content = page_content(inputs, placed, lost, tones, shown)
        text = render(content, {**data, "shown": shown.document()})
        if len(text.encode("utf-8")) <= MAX_BYTES:
            break
    context.progress(2, 3, "page")
    write_text(path, text)
    context.progress(3, 3, "")


def _fewer(pictures: Mapping[str, Any], shown: Shown) -> dict[str, Any]:
    """A camera's series, thinned to its share, and what was left out of it accounted for."""
    frames = pictures["frames"]
    most = shown.of(len(frames))
    kept = thinned(len(frames), most)[:most]
    shown.note("video frames as pictures", len(kept), pictures["count"])
    return {**pictures, "frames": [frames[index] for index in kept]}


def _pictures(inputs: ReportInputs, context: StageContext) -> list[dict[str, Any]]:
    """The picture series of every camera with what is drawn over each picture."""
    if inputs.capture is None:
        return []
    marks, out = Marks(inputs), []
    for name in inputs.cameras:
        camera = inputs.capture.camera(name)
        times = common_times_s(inputs, name, camera.times_ns)
        pictures = series(camera, times, SERIES_BUDGET // len(inputs.cameras), context)
        out.append(
            {
                "camera": name,
                "size": [camera.camera.width_px, camera.camera.height_px],
                "count": len(camera.frame_numbers),
                "frames": [
                    {"t": round(float(times[picture.index]), 6), "jpeg": picture.jpeg, **mark}
                    for picture, mark in zip(
                        pictures, marks.over(name, [each.index for each in pictures]), strict=True
                    )
                ],
            }
        )
    return out
