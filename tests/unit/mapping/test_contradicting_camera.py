"""One camera that contradicts the map of the others is left out, and does not end the job."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping import build
from bodycap_batch.mapping.validation.epipolar_consistency import (
    PairConsistency,
    find_contradicting_camera,
)
from bodycap_batch.model.scene import KeyframeSelection, MapResult
from tests.scenes import small_map

_CAMERAS = dict(enumerate(("torso", "left_palm", "right_palm") * 4))


def _pairs(*wrong: tuple[str, str]) -> list[PairConsistency]:
    """Return all pairs of images; those between two cameras in `wrong`, in any order, are inconsistent."""
    return [
        PairConsistency(
            a, b, 50, 0.1 if {(_CAMERAS[a], _CAMERAS[b]), (_CAMERAS[b], _CAMERAS[a])} & set(wrong) else 1.0
        )
        for a in _CAMERAS
        for b in range(a)
    ]


def test_the_camera_that_contradicts_all_others_is_found() -> None:
    assert find_contradicting_camera(_pairs(), _CAMERAS) is None
    wrong = (("left_palm", "torso"), ("left_palm", "right_palm"))
    assert find_contradicting_camera(_pairs(*wrong), _CAMERAS) == "left_palm"
    assert find_contradicting_camera(_pairs(*wrong, ("left_palm", "left_palm")), _CAMERAS) == "left_palm"


def test_no_camera_is_left_out_if_it_is_not_the_only_explanation() -> None:
    assert find_contradicting_camera(_pairs(("left_palm", "right_palm")), _CAMERAS) is None
    every = [(one, other) for one in _CAMERAS.values() for other in _CAMERAS.values()]
    assert find_contradicting_camera(_pairs(*every), _CAMERAS) is None


def _selection(camera: str) -> KeyframeSelection:
    return KeyframeSelection(
        camera=camera, frames=np.arange(3), frame_count=9, sharpness=np.ones(9), noise_px=0.1
    )


def _build(
    monkeypatch: pytest.MonkeyPatch, folder: Path, refused: tuple[EstimationError | None, ...]
) -> tuple[MapResult, list[tuple[list[str], MapOptions]]]:
    calls: list[tuple[list[str], MapOptions]] = []

    def build_once(
        _: Any, selections: list[KeyframeSelection], options: MapOptions, *__: Any
    ) -> tuple[MapResult, EstimationError | None]:
        error = refused[len(calls)]
        calls.append(([item.camera for item in selections], options))
        log = {"repair": {"contradicting_camera": "left_palm"}} if error is refused[0] and error else {}
        return MapResult(maps=(small_map(),), workspace=folder, log=log), error

    monkeypatch.setattr(build, "build_map_once", build_once)
    selections = [_selection(name) for name in ("torso", "left_palm", "right_palm")]
    options = MapOptions(init_frames=("left_palm:0", "torso:1"))
    return build.build_map(cast(Capture, None), selections, options, StageContext(work_dir=folder)), calls


def test_the_map_is_built_again_without_the_camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    result, calls = _build(monkeypatch, tmp_path, (EstimationError("contradicts"), None))
    assert [names for names, _ in calls] == [["torso", "left_palm", "right_palm"], ["torso", "right_palm"]]
    assert calls[1][1].init_frames is None
    assert result.diagnostics.contradicting_cameras == ("left_palm",)


def test_the_first_error_is_raised_if_the_map_without_the_camera_is_unusable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(EstimationError, match="contradicts"):
        _build(monkeypatch, tmp_path, (EstimationError("contradicts"), EstimationError("again")))
