"""The typed diagnostics of a map and its stored log are the same."""

from __future__ import annotations

import json
from dataclasses import replace

from bodycap_batch.model.map_diagnostics import MapDiagnostics, RefinedIntrinsics

LOG = {
    "keyframes": 12,
    "mirror_images": [[["left_palm"], ["torso", "head"]]],
    "mirrored_cameras": ["hat"],
    "named_initial_pair": {"failed": "a mirrored camera was left out", "left_out": ["hat"]},
    "pairs": 30,
    "misfitting_lenses": {"torso": 1.31},
    "reach": {"judged": True, "within_reach": 0.9},
    "freed_lenses": ["torso"],
    "found_lenses": {"torso": {"model": "RADIAL", "params": [400.0, 320.0, 240.0, 0.1, 0.0]}},
    "growth": [{"new_keyframes": 2}],
    "uncorrected_shutters": ["torso"],
}


def test_a_log_is_read_and_written_without_a_change() -> None:
    again = MapDiagnostics.from_log(LOG).to_log()
    assert json.dumps(again) == json.dumps(LOG)


def test_the_fields_hold_what_the_log_holds() -> None:
    found = MapDiagnostics.from_log(LOG)
    assert found.undecided_groups == ((("left_palm",), ("torso", "head")),)
    assert found.flipped_cameras == found.excluded_from_pair == ("hat",)
    assert found.misfit_factors == {"torso": 1.31}
    assert found.recalibrated == ("torso",)
    assert found.refined_intrinsics == {"torso": RefinedIntrinsics("RADIAL", (400.0, 320.0, 240.0, 0.1, 0.0))}
    assert found.reach == LOG["reach"]
    assert found.uncorrected_shutters == ("torso",)
    assert found.extensions == ({"new_keyframes": 2},)


def test_keyframes_that_an_earlier_refinement_found_misplaced_are_removed() -> None:
    before = MapDiagnostics.from_log({**LOG, "misplaced_keyframes": {"torso": [3]}})
    assert replace(before, misplaced={}).to_log()["misplaced_keyframes"] == {}


def test_an_empty_log_has_no_findings() -> None:
    assert MapDiagnostics.from_log({}) == MapDiagnostics()
    assert MapDiagnostics().to_log() == {}


def test_no_misfit_differs_from_no_check() -> None:
    assert MapDiagnostics.from_log({"misfitting_lenses": {}}).misfit_factors == {}
    assert MapDiagnostics.from_log({}).misfit_factors is None
    assert MapDiagnostics(misfit_factors={}).to_log() == {"misfitting_lenses": {}}
