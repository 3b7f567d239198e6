"""Frames with exposure and rolling shutter agree with the mean of many images of single instants."""

import numpy as np
import pytest

from bodycap_batch.synthetic import making
from bodycap_batch.synthetic.making import build_renderers, draw_subject
from bodycap_batch.synthetic.options import SynthOptions

EXPOSURE_S, READOUT_S = 0.012, 0.020
FISHEYE = {"lens": "OPENCV_FISHEYE", "lens_params": (48.0, 48.0, 64.0, 40.0, 0.02, -0.005, 0.0, 0.0)}


@pytest.fixture(scope="module", autouse=True)
def _rooms():
    """Build the room of all renderers once for each detail of its textures."""
    built, build = {}, making.build_room

    def build_once(extent_m, texels_per_m, *rest):
        if texels_per_m not in built:
            built[texels_per_m] = build(extent_m, texels_per_m, *rest)
        return built[texels_per_m]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "build_room", build_once)
        yield


def _options(**values):
    return SynthOptions(**{
        "width": 128, "height": 80, "seconds": 4.0, "cameras": ("torso",), "seed": 3, "body_in_view": True,
        "arms_ahead": 1.0, "exposure_s": EXPOSURE_S, "rolling_shutter_s": READOUT_S, **values,
    })  # fmt: skip


def _renderer(**values):
    options = _options(**values)
    return build_renderers(options, draw_subject(options))[0]


def _brute(instant, t_s, instants, bands):
    """Return the mean of images of many instants; all rows of a band share the instant of their exposure."""
    height = 80
    total = np.zeros((height, 128, 3))
    for part in np.array_split(np.arange(height), bands):
        row_s = ((part.mean() + 0.5) / height - 0.5) * READOUT_S
        for step in (np.arange(instants) + 0.5) / instants - 0.5:
            total[part] += instant.render(t_s + row_s + step * EXPOSURE_S)[part]
    return total / instants


@pytest.mark.parametrize("lens", [{}, FISHEYE])
def test_a_frame_is_the_mean_over_the_exposure_of_each_row(lens):
    seen = _renderer(**lens).render(1.0).astype(float)
    instant = _renderer(exposure_s=0.0, rolling_shutter_s=0.0, **lens)
    expected, still = _brute(instant, 1.0, 5, 13), instant.render(1.0).astype(float)
    error = np.abs(seen - expected)
    # The default noise has a standard deviation of 2 grey levels, thus a mean absolute value of 1.6.
    assert error.mean() < 1.2
    assert np.percentile(error, 99) < 12.0
    # A frame without blur and rolling shutter is much worse.
    assert np.abs(still - expected).mean() > 2.0 * error.mean()
    # The shift between the images along each axis, from the difference divided by the slope: least squares.
    slopes = [part[1:-1, 1:-1].ravel() for part in np.gradient(expected, axis=(0, 1))]
    shift = np.linalg.lstsq(np.stack(slopes, axis=1), (seen - expected)[1:-1, 1:-1].ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.05


def test_a_very_short_readout_gives_the_frame_of_one_instant():
    at_once = _renderer(exposure_s=0.0, rolling_shutter_s=0.0).render(1.0).astype(float)
    difference = np.abs(at_once - _renderer(exposure_s=0.0, rolling_shutter_s=1e-9).render(1.0))
    # Texel coordinates are interpolated over 4 px, and cells share filters.
    assert 0.0 < difference.mean() < 0.3
