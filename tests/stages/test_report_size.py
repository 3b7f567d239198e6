"""The report fits into 15 MB whatever the job was, and says what was thinned for it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.report import ReportInputs, page, stage
from bodycap_batch.report.packing import pack_scaled
from bodycap_batch.report.pictures import SERIES_BUDGET
from tests.reports import report_inputs, written


def many_pictures(inputs: ReportInputs, each: int, length: int) -> list[dict[str, object]]:
    """Series of so many pictures a camera, of so many characters each."""
    nowhere = pack_scaled(np.zeros((0, 2)))
    told = {"status": "REGISTERED", "inliers": 40, "error": 0.5, "inliersAt": nowhere, "bones": []}
    frames = [{"t": index / 30, "jpeg": "A" * length, "i": index, **told} for index in range(each)]
    return [{"camera": name, "size": [64, 48], "count": each, "frames": frames} for name in inputs.cameras]


def test_a_page_that_would_be_too_large_is_thinned_until_it_fits_and_says_so(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 3 cameras of 400 pictures of 40 kB: 48 MB before anything is left out
    monkeypatch.setattr(stage, "_pictures", lambda inputs, context: many_pictures(inputs, 400, 40_000))
    text = written(inputs, tmp_path)
    assert 5_000_000 < len(text.encode()) <= stage.MAX_BYTES
    found = re.search(r"it shows .*?([\d,]+) of 1,200 video frames as pictures", text)
    assert found is not None
    assert re.search(r"\. +<code>bodycap view", text), "a space between two sentences"
    assert 0 < int(found[1]) == text.count('"jpeg":"A') < 375


@pytest.mark.parametrize("room", [200_000, 800_000])
def test_any_page_fits_though_cameras_are_many_and_room_is_little(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    names = [f"camera_{index:02}" for index in range(12)]
    many = [
        replace(found, trajectory=replace(found.trajectory, camera=name))
        for name, found in zip(names, 4 * inputs.registrations, strict=True)
    ]
    clocks = dict.fromkeys(names, next(iter(inputs.clocks.values())))
    broken_off = ReportInputs(
        name="x", cameras=tuple(names), maps=inputs.maps, registrations=tuple(many), clocks=clocks
    )
    monkeypatch.setattr(stage, "_pictures", lambda inputs, context: many_pictures(inputs, 50, 10_000))
    monkeypatch.setattr(page, "library", lambda: "library")
    monkeypatch.setattr(stage, "MAX_BYTES", room)
    text = written(broken_off, tmp_path)
    assert len(text.encode()) <= room
    assert re.search(r"it shows .* of 480 points of each curve over time", text)


@pytest.mark.parametrize("frames", [1000, pytest.param(18_000, marks=pytest.mark.slow)])
def test_the_page_stays_under_15_mb_at_any_length(frames: int, tmp_path: Path) -> None:
    long = report_inputs(frames, points=1_000, lost=slice(20, 25))
    text = written(long, tmp_path)
    # No videos here: their pictures have a budget of their own, and a lost frame's picture some 16 kB.
    assert len(text.encode()) + SERIES_BUDGET + 24 * 16_000 <= 15_000_000
    if frames > 5_000:
        assert re.search(r"To keep it small it shows [\d,]+ of [\d,]+ ", text)
