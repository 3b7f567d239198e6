"""Whole jobs on rendered captures that are hard in one way each, scored against the exact truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.pipeline.hard_captures import (
    check_is_right,
    render,
)

pytestmark = pytest.mark.slow

CASES: dict[str, dict[str, Any]] = {
    # Drawn many times over for each frame: shorter, and two cameras.
    "blurred": {"exposure_s": 0.008, "cameras": ("torso", "left_palm"), "seconds": 3.0},
    "rolling": {"rolling_shutter_s": 0.02, "cameras": ("torso", "left_palm"), "seconds": 3.0},
    # With the forearms held up, palms see the ceiling alone; chest and head see the arms before the room.
    "arms in view": {"cameras": ("torso", "head"), "body_in_view": True, "arms_ahead": 1.0},
}


@pytest.mark.parametrize("case", CASES)
def test_a_hard_capture_is_registered_and_right(case: str, tmp_path: Path) -> None:
    check_is_right(render(tmp_path, **CASES[case]))
