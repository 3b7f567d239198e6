"""Lenses that tracks determine enter the map as if they were given; an extension keeps those of the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.mapping.inputs import with_estimated_lenses, with_map_lenses
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.scene import KeyframeSelection, MapResult
from tests.scenes import small_map


def lens(focal_px: float, *, refine: bool = True) -> Camera:
    params = np.array([focal_px, 320.0, 240.0, 0.0])
    return Camera(model="SIMPLE_RADIAL", width_px=640, height_px=480, params=params, refine=refine)


def camera(name: str, *, known: bool) -> CaptureCamera:
    return CaptureCamera(
        name=name,
        chapters=(),
        camera=lens(600.0, refine=not known),
        calibrated=known,
        frame_numbers=np.arange(9),
        times_ns=np.arange(9) * 10**8,
        nominal_fps=10.0,
        rolling_shutter_s=0.0,
    )


def selection(name: str, sigma: float) -> KeyframeSelection:
    found = LensEstimate(lens=lens(450.0), focal_sigma=sigma, pairs=36, error_px=0.2)
    return KeyframeSelection(
        camera=name, frames=np.array([0]), frame_count=9, sharpness=np.ones(9), noise_px=0.1, lens=found
    )


@pytest.mark.parametrize(
    ("known", "sigma", "focal_px"), [(False, 0.05, 450.0), (False, 0.25, 600.0), (True, 0.05, 600.0)]
)
def test_a_determined_lens_replaces_an_unknown_one(sigma: float, focal_px: float, *, known: bool) -> None:
    capture = with_estimated_lenses(
        Capture(cameras=(camera("torso", known=known),)), [selection("torso", sigma)]
    )
    found = capture.camera("torso")
    assert found.camera.focal_px == focal_px
    assert found.calibrated is (known or focal_px == 450.0)
    assert found.lens_sigma == (sigma if focal_px == 450.0 else 0.0)
    assert found.camera.refine is not found.calibrated


def test_an_extension_keeps_the_lens_of_the_map(tmp_path: Path) -> None:
    names = ("torso", "left_palm", "head")
    capture = Capture(cameras=tuple(camera(name, known=False) for name in names))
    capture = with_estimated_lenses(capture, [selection("torso", 0.05), selection("head", 0.05)])
    extended = with_map_lenses(capture, MapResult(maps=(small_map(),), workspace=tmp_path, log={}))
    assert extended.camera("torso").camera.focal_px == 500.0, "that of the map"
    assert extended.camera("torso").lens_sigma == 0.0, "it stays constant"
    assert extended.camera("torso").calibrated
    assert extended.camera("head").camera.focal_px == 450.0, "the camera is not in the map"
    assert extended.camera("left_palm").camera.refine, "only the map determines its lens"
