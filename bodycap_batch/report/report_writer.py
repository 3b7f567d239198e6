"""Write ``report.html``, the report page of a job, and ``verdict.json`` beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.palette import camera_colours, hex_from_colour
from bodycap_batch.report.content import page_content
from bodycap_batch.report.drawn_scene import common_times_s, make_drawn_scene
from bodycap_batch.report.frame_losses import diagnose_losses
from bodycap_batch.report.frame_overlays import FrameOverlays
from bodycap_batch.report.frame_pictures import SERIES_BUDGET, picture_series
from bodycap_batch.report.packing import PageBudget
from bodycap_batch.report.page import render_page
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.verdict import VERDICT_FILE, judge
from bodycap_batch.report.viewer_data import make_viewer_data

REPORT_FILE = "report.html"
MAX_BYTES = 15_000_000
"""Maximum size of the page, bytes. A page of this size can still be sent by e-mail."""
_BUDGET_SHARES = (1.0, *(0.6**step for step in range(1, 16)))
"""Factors by which all size budgets are multiplied, tried one after the other until the page is small enough.

With the last factor, little more than text and tables remains.
"""


def write_report(inputs: ReportInputs, path: Path, context: StageContext) -> None:
    """Write the report page as one file of at most 15 MB, however long the capture is, and the verdict.

    The verdict is written to `VERDICT_FILE` in the folder of the page.
    If the page is too large, it is rendered again with smaller budgets until it is small enough. The page
    then states how many items of each thinned kind are shown, for example pictures or points.

    Args:
        inputs: The results of the job.
        path: Path of the file to write.
        context: The context of the stage, which receives the progress and can cancel the stage.

    Raises:
        StoreError: The file cannot be written.
    """
    scene = make_drawn_scene(inputs)
    colours = {name: hex_from_colour(colour) for name, colour in camera_colours(inputs.cameras).items()}
    context.progress(0, 3, "pictures")
    losses = diagnose_losses(inputs, context)
    verdict = judge(inputs.metrics, inputs.failure, losses)
    write_text(
        path.with_name(VERDICT_FILE), json.dumps(verdict.to_dict(), indent=1, ensure_ascii=False) + "\n"
    )
    all_series = make_picture_series(inputs, context) if scene.has_content else []
    context.progress(1, 3, "figures")
    for share in _BUDGET_SHARES:
        context.check_cancelled()
        budget = PageBudget(share=share)
        data = {
            "name": inputs.name,
            "tones": colours,
            "solid": make_viewer_data(inputs, scene, budget),
            "pictures": [_thin_series(series, budget) for series in all_series],
        }
        content = page_content(inputs, verdict, scene, losses, colours, budget)
        text = render_page(content, {**data, "shown": budget.to_dict()})
        if len(text.encode("utf-8")) <= MAX_BYTES:
            break
    context.progress(2, 3, "page")
    write_text(path, text)
    context.progress(3, 3, "")


def _thin_series(series: Mapping[str, Any], budget: PageBudget) -> dict[str, Any]:
    """Return a camera's picture series thinned to the budget, and record how many pictures are shown."""
    frames = series["frames"]
    most = budget.scaled(len(frames))
    kept = evenly_spaced(len(frames), max(most, 2))[:most]
    budget.record("video frames as pictures", len(kept), series["count"])
    return {**series, "frames": [frames[index] for index in kept]}


def make_picture_series(inputs: ReportInputs, context: StageContext) -> list[dict[str, Any]]:
    """Return the picture series of each camera as JSON values. The list is empty without videos.

    Each picture is stored together with the overlays of its frame.
    """
    if inputs.capture is None:
        return []
    overlays, all_series = FrameOverlays(inputs), []
    for name in inputs.cameras:
        camera = inputs.capture.camera(name)
        times = common_times_s(inputs, name, camera.times_ns)
        pictures = picture_series(camera, times, SERIES_BUDGET // len(inputs.cameras), context)
        of_frames = overlays.describe(name, [picture.index for picture in pictures])
        all_series.append(
            {
                "camera": name,
                "size": [camera.camera.width_px, camera.camera.height_px],
                "count": len(camera.frame_numbers),
                "frames": [
                    {"t": round(float(times[picture.index]), 6), "jpeg": picture.jpeg, **overlay}
                    for picture, overlay in zip(pictures, of_frames, strict=True)
                ],
            }
        )
    return all_series
