"""Given lenses that the map contradicts are found along with it, where that gives the better map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.capture.cameras import CaptureCamera
from bodycap_batch.errors import EstimationError
from bodycap_batch.mapping.freeing import FREED, as_mapped, freed_where_contradicted
from bodycap_batch.scene import MapResult
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
            offset_s=0.0,
            rolling_shutter_s=0.0,
        )
        for name, lens in small_map().cameras.items()
    )
)


def _mapped(error_px: float, misfits: dict[str, float], zoom: float = 1.0) -> MapResult:
    """A map with that error; the palm's lens is off by a factor."""
    scene = small_map(noise_px=error_px)
    lens = scene.cameras["left_palm"]
    zoomed = replace(lens, params=lens.params * [zoom, zoom, 1.0, 1.0])
    scene = replace(scene, cameras={**scene.cameras, "left_palm": zoomed})
    return MapResult(maps=(scene,), workspace=Path(), log={"misfitting_lenses": misfits})


def test_a_contradicted_lens_starts_from_what_fits_and_is_refined() -> None:
    seen = []

    def build(capture: Capture) -> MapResult:
        seen.append(capture)
        return _mapped(0.5, {}, zoom=1.33)

    found = freed_where_contradicted(_mapped(0.9, {"left_palm": 1.31}), CAPTURE, build)
    (capture,) = seen
    assert not capture.camera("left_palm").calibrated
    start = capture.camera("left_palm").camera
    # As if the lens were not given: mapping looks for its kind, too.
    assert (start.model, start.refine) == ("SIMPLE_RADIAL", True)
    assert np.allclose(start.params, [1.31 * 485, 318, 242, 0])
    assert capture.camera("torso") is CAPTURE.camera("torso")
    assert found.log["misfitting_lenses"] == {"left_palm": 1.33}
    assert found.log[FREED] == ["left_palm"]
    later = as_mapped(CAPTURE, found)
    assert later.camera("left_palm").camera is found.maps[0].cameras["left_palm"]
    assert not later.camera("left_palm").calibrated
    assert later.camera("torso").calibrated


@pytest.mark.parametrize("again", [_mapped(1.0, {}), None], ids=["a worse map", "no map"])
def test_the_given_lens_stays_where_freeing_it_gives_no_better_map(again: MapResult | None) -> None:
    def build(capture: Capture) -> MapResult:
        if again is None:
            raise EstimationError("nothing holds", hint="x")
        return again

    first = _mapped(0.9, {"left_palm": 1.31})
    found = freed_where_contradicted(first, CAPTURE, build)
    assert found.maps == first.maps
    assert found.log["misfitting_lenses"] == {"left_palm": 1.31}
    assert FREED not in found.log
    assert as_mapped(CAPTURE, found).cameras == CAPTURE.cameras


def test_lenses_that_fit_cost_no_second_map() -> None:
    first = _mapped(0.5, {})
    assert freed_where_contradicted(first, CAPTURE, lambda capture: pytest.fail("built again")) is first
