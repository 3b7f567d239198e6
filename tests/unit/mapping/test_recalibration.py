"""Given intrinsics that the map contradicts are refined if that gives a better map."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.capture.cameras import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping import build
from bodycap_batch.mapping.intrinsics.recalibration import (
    recalibrate_if_misfit,
    with_map_intrinsics,
)
from bodycap_batch.model.scene import MapResult
from tests.scenes import small_map

CAPTURE = Capture(
    cameras=tuple(
        CaptureCamera(
            name=name,
            chapters=(Path(f"{name}.mp4"),),
            camera=lens,
            calibrated=True,
            frame_numbers=np.arange(9),
            times_ns=np.arange(9) * 33_000_000,
            nominal_fps=30.0,
            rolling_shutter_s=0.0,
        )
        for name, lens in small_map().cameras.items()
    )
)


def _mapped(error_px: float, misfits: dict[str, float], zoom: float = 1.0) -> MapResult:
    """Return a map with a mean error; the focal length of the palm's camera is off by a factor."""
    scene = small_map(noise_px=error_px)
    lens = scene.cameras["left_palm"]
    zoomed = replace(lens, params=lens.params * [zoom, zoom, 1.0, 1.0])
    scene = replace(scene, cameras={**scene.cameras, "left_palm": zoomed})
    return MapResult(maps=(scene,), workspace=Path(), log={"misfitting_lenses": misfits})


def test_new_intrinsics_keep_the_direction_of_the_sensor() -> None:
    palm = CAPTURE.camera("left_palm")
    turned = replace(palm, camera=replace(palm.camera, sideways=True))
    capture = replace(CAPTURE, cameras=(turned, CAPTURE.camera("torso")))
    found = recalibrate_if_misfit(_mapped(0.9, {"left_palm": 1.31}), capture, lambda _: _mapped(0.5, {}))
    later = with_map_intrinsics(capture, found)
    assert {each.name: each.camera.sideways for each in later.cameras} == {"left_palm": True, "torso": False}


@pytest.mark.parametrize("zoom", [0.3, 9.5])
def test_an_absurd_lens_is_no_evidence_against_the_given_one(zoom: float) -> None:
    """A map of a table from one side fitted a focal length of 9.5 times the right one."""
    first = _mapped(0.9, {"left_palm": 1.07})
    found = recalibrate_if_misfit(first, CAPTURE, lambda _: _mapped(0.5, {}, zoom=zoom))
    assert found.maps == first.maps
    assert found.diagnostics.recalibrated == ()


def test_misfit_intrinsics_start_from_the_focal_length_that_fits() -> None:
    seen = []

    def build(capture: Capture) -> MapResult:
        seen.append(capture)
        return _mapped(0.5, {}, zoom=1.33)

    found = recalibrate_if_misfit(_mapped(0.9, {"left_palm": 1.31}), CAPTURE, build)
    (capture,) = seen
    assert not capture.camera("left_palm").calibrated
    assert capture.camera("left_palm").given is CAPTURE.camera("left_palm").camera
    start = capture.camera("left_palm").camera
    # As for an uncalibrated camera: mapping selects the camera model, too.
    assert (start.model, start.refine) == ("SIMPLE_RADIAL", True)
    assert np.allclose(start.params, [1.31 * 485, 318, 242, 0])
    assert capture.camera("torso") is CAPTURE.camera("torso")
    assert found.diagnostics.misfit_factors == {"left_palm": 1.33}
    assert found.diagnostics.recalibrated == ("left_palm",)
    later = with_map_intrinsics(CAPTURE, found)
    kept, mapped = later.camera("left_palm").camera, found.maps[0].cameras["left_palm"]
    assert (kept.model, kept.params.tolist()) == (mapped.model, mapped.params.tolist())
    assert not later.camera("left_palm").calibrated
    assert later.camera("torso").calibrated


@pytest.mark.parametrize("again", [_mapped(1.0, {}), None], ids=["a worse map", "no map"])
def test_the_given_intrinsics_stay_if_refinement_gives_no_better_map(again: MapResult | None) -> None:
    def build(capture: Capture) -> MapResult:
        if again is None:
            raise EstimationError("nothing holds", hint="x")
        return again

    first = _mapped(0.9, {"left_palm": 1.31})
    found = recalibrate_if_misfit(first, CAPTURE, build)
    assert found.maps == first.maps
    assert found.diagnostics.misfit_factors == {"left_palm": 1.31}
    assert not found.diagnostics.recalibrated
    assert with_map_intrinsics(CAPTURE, found).cameras == CAPTURE.cameras


def _without_palm(mapped: MapResult) -> MapResult:
    """Return the same map without the keyframes of the palm's camera."""
    scene = mapped.maps[0]
    rows = [row for row, name in enumerate(scene.keyframe_camera) if name == "torso"]
    seen = np.isin(scene.obs_keyframe, rows)
    less = replace(
        scene,
        cameras={"torso": scene.cameras["torso"]},
        keyframe_camera=("torso",) * len(rows),
        keyframe_frame=scene.keyframe_frame[rows],
        map_from_cam=scene.map_from_cam[rows],
        obs_keyframe=scene.obs_keyframe[seen],
        obs_point=scene.obs_point[seen],
        obs_feature=scene.obs_feature[seen],
        obs_px=scene.obs_px[seen],
    )
    return replace(mapped, maps=(less,))


def test_refined_intrinsics_outlast_the_keyframes_of_their_camera() -> None:
    found = recalibrate_if_misfit(
        _mapped(0.9, {"left_palm": 1.31}), CAPTURE, lambda capture: _mapped(0.5, {}, zoom=1.33)
    )
    lens = with_map_intrinsics(CAPTURE, _without_palm(found)).camera("left_palm")
    assert not lens.calibrated
    assert np.allclose(lens.camera.params, found.maps[0].cameras["left_palm"].params)
    assert json.loads(json.dumps(found.log)) == found.log


def test_a_map_that_loses_the_misfit_camera_is_not_better() -> None:
    first = _mapped(0.9, {"left_palm": 1.31})
    found = recalibrate_if_misfit(first, CAPTURE, lambda capture: _without_palm(_mapped(0.5, {})))
    assert found.maps == first.maps
    assert found.diagnostics.misfit_factors == {"left_palm": 1.31}
    assert found.log["freeing_refused"] == {"keyframes": {"torso": 3}, "mean_error_px": 0.5}


def test_an_unusable_map_is_refused_only_after_refinement() -> None:
    refused = EstimationError("30% of the matches contradict the map", hint="x")
    bad = _mapped(0.4, {"left_palm": 1.31})
    found = recalibrate_if_misfit(bad, CAPTURE, lambda capture: _mapped(0.5, {}, zoom=1.33), refused)
    assert found.diagnostics.recalibrated == ("left_palm",)
    with pytest.raises(EstimationError, match="30%"):
        recalibrate_if_misfit(bad, CAPTURE, lambda capture: _without_palm(_mapped(0.5, {})), refused)
    with pytest.raises(EstimationError, match="30%"):
        recalibrate_if_misfit(_mapped(0.4, {}), CAPTURE, lambda capture: pytest.fail("built"), refused)


def test_refinement_is_tried_before_a_map_is_given_up(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    refused = EstimationError("30% of the matches contradict the map", hint="x")

    def built(capture: Capture, *_: object) -> tuple[MapResult, EstimationError | None]:
        if capture.camera("left_palm").calibrated:
            return _mapped(0.4, {"left_palm": 1.31}), refused
        return _mapped(0.5, {}, zoom=1.33), None

    monkeypatch.setattr(build, "build_map_once", built)
    found = build.build_map(CAPTURE, [], MapOptions(), StageContext(work_dir=tmp_path))
    assert found.diagnostics.recalibrated == ("left_palm",)
    monkeypatch.setattr(build, "build_map_once", lambda *_: (_mapped(0.4, {"left_palm": 1.31}), refused))
    with pytest.raises(EstimationError, match="30%"):
        build.build_map(CAPTURE, [], MapOptions(), StageContext(work_dir=tmp_path))


def test_intrinsics_that_fit_cost_no_second_map() -> None:
    first = _mapped(0.5, {})
    assert recalibrate_if_misfit(first, CAPTURE, lambda capture: pytest.fail("built again")) is first
