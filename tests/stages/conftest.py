"""One small rendered capture, mapped and registered once for all stage tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import KeyframeOptions, MapOptions, RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping import build_map
from bodycap_batch.model.scene import KeyframeSelection, MapResult, Registration
from bodycap_batch.registration import register_frames
from bodycap_batch.report import ReportInputs
from tests.reports import report_inputs
from tests.rooms import stroll, write_capture

FRAMES = 60
DARK = range(34, 40)
"""Frames of the palm's camera with the light off."""


@dataclass(frozen=True)
class Estimated:
    """A capture with the results of the first three stages."""

    capture: Capture
    truth: dict[str, np.ndarray]
    selections: tuple[KeyframeSelection, ...]
    result: MapResult
    registrations: tuple[Registration, ...]


def context(folder: Path) -> StageContext:
    """Return a stage context with its own folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return StageContext(work_dir=folder, threads=2)


@pytest.fixture(scope="session")
def stroll_capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Two cameras, two seconds; the palm's camera is dark for a moment."""
    return write_capture(tmp_path_factory.mktemp("stroll"), stroll(FRAMES), black={"left_palm": DARK})


@pytest.fixture(scope="session")
def estimated(stroll_capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Estimated:
    """The capture, mapped and registered with default options."""
    work = tmp_path_factory.mktemp("estimated")
    selections = tuple(
        select_keyframes(camera, KeyframeOptions(), context(work / camera.name))
        for camera in stroll_capture.cameras
    )
    result = build_map(stroll_capture, selections, MapOptions(), context(work / "map"))
    registrations = tuple(
        register_frames(camera, result.maps, selection, RegistrationOptions(), context(work / "registration"))
        for camera, selection in zip(stroll_capture.cameras, selections, strict=True)
    )
    return Estimated(stroll_capture, stroll(FRAMES), selections, result, registrations)


@pytest.fixture(scope="session")
def inputs() -> ReportInputs:
    """The inputs of a report: the results of a whole job, without videos."""
    return report_inputs()
