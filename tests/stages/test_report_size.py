"""The report is at most 15 MB whatever the job is, and it states what was thinned."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.report import ReportInputs, page, report_writer
from bodycap_batch.report.frame_pictures import SERIES_BUDGET
from bodycap_batch.report.packing import pack_scaled
from tests.reports import report_inputs, written


def many_pictures(inputs: ReportInputs, count: int, length: int) -> list[dict[str, object]]:
    """Return a series of `count` pictures for each camera, each of `length` characters."""
    no_points = pack_scaled(np.zeros((0, 2)))
    overlay = {"status": "REGISTERED", "inliers": 40, "error": 0.5, "inliersAt": no_points, "bones": []}
    frames = [{"t": index / 30, "jpeg": "A" * length, "i": index, **overlay} for index in range(count)]
    return [{"camera": name, "size": [64, 48], "count": count, "frames": frames} for name in inputs.cameras]


def test_a_page_that_is_too_large_is_thinned_until_it_fits_and_states_what_was_thinned(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Three cameras with 400 pictures of 40 kB: 48 MB before thinning.
    monkeypatch.setattr(
        report_writer, "make_picture_series", lambda inputs, context: many_pictures(inputs, 400, 40_000)
    )
    text = written(inputs, tmp_path)
    assert 5_000_000 < len(text.encode()) <= report_writer.MAX_BYTES
    found = re.search(r"it shows .*?([\d,]+) of 1,200 video frames as pictures", text)
    assert found is not None
    assert re.search(r"\. +<code>bodycap view", text), "a space between two sentences"
    assert 0 < int(found[1]) == text.count('"jpeg":"A') < 375


@pytest.mark.parametrize("max_bytes", [200_000, 800_000])
def test_a_page_with_many_cameras_fits_into_a_small_limit(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_bytes: int
) -> None:
    names = [f"camera_{index:02}" for index in range(12)]
    many = [
        replace(found, trajectory=replace(found.trajectory, camera=name))
        for name, found in zip(names, 4 * inputs.registrations, strict=True)
    ]
    clocks = dict.fromkeys(names, next(iter(inputs.clocks.values())))
    stopped_job = ReportInputs(
        name="x", cameras=tuple(names), maps=inputs.maps, registrations=tuple(many), clocks=clocks
    )
    monkeypatch.setattr(
        report_writer, "make_picture_series", lambda inputs, context: many_pictures(inputs, 50, 10_000)
    )
    monkeypatch.setattr(page, "viewer_library", lambda: "library")
    monkeypatch.setattr(report_writer, "MAX_BYTES", max_bytes)
    text = written(stopped_job, tmp_path)
    assert len(text.encode()) <= max_bytes
    assert re.search(r"it shows .* of 480 points of each curve over time", text)


@pytest.mark.parametrize("frames", [1000, pytest.param(18_000, marks=pytest.mark.slow)])
def test_the_page_stays_under_15_mb_at_any_length(frames: int, tmp_path: Path) -> None:
    long = report_inputs(frames, points=1_000, lost=slice(20, 25))
    text = written(long, tmp_path)
    # There are no videos here. Their pictures have their own budget; a lost frame's picture is about 16 kB.
    assert len(text.encode()) + SERIES_BUDGET + 24 * 16_000 <= 15_000_000
    if frames > 5_000:
        assert re.search(r"To keep this page small, it shows only [\d,]+ of [\d,]+ ", text)
