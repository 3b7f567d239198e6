"""The motion blur that exposure times and turn rates predict, and the keyframes that are selected by it."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.keyframes import _Candidate
from bodycap_batch.model.camera import Camera
from bodycap_batch.telemetry.blur import predicted_blur_px
from bodycap_batch.telemetry.streams import EXPOSURE, GYROSCOPE, CameraTelemetry, Stream

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([500.0, 500.0, 320.0, 240.0]))
FRAMES_S = np.arange(30) / 30.0


def stream(key: str, times_s: FloatArray, values: FloatArray) -> Stream:
    rate_hz = float(1.0 / np.median(np.diff(times_s)))
    return Stream(key=key, name=key, unit="", times_s=times_s, values=values, rate_hz=rate_hz)


def telemetry(rate: FloatArray, exposure_s: FloatArray, *, axes_known: bool = True) -> CameraTelemetry:
    """Return a recording with a constant turn rate, and exposure times of frames."""
    times_s = np.arange(-0.2, 1.2, 0.005)
    streams = {
        GYROSCOPE: stream(GYROSCOPE, times_s, np.tile(rate, (len(times_s), 1))),
        EXPOSURE: stream(EXPOSURE, FRAMES_S[: len(exposure_s)] + 0.001, exposure_s[:, None]),
    }
    return CameraTelemetry(source="GPMF", streams=streams, axes_known=axes_known)


def test_blur_is_exposure_times_turn_rate_times_focal_length() -> None:
    exposure_s = np.linspace(0.002, 0.016, 30)
    blur_px = predicted_blur_px(FRAMES_S, LENS, telemetry(np.array([0.0, 4.0, 0.0]), exposure_s))
    np.testing.assert_allclose(blur_px, 500.0 * 4.0 * exposure_s, rtol=1e-6)
    rolled = predicted_blur_px(FRAMES_S, LENS, telemetry(np.array([0.0, 0.0, 4.0]), exposure_s))
    np.testing.assert_allclose(rolled, 0.5 * 500.0 * 4.0 * exposure_s, rtol=1e-6)


def test_the_number_of_exposures_may_differ_by_one() -> None:
    blur_px = predicted_blur_px(FRAMES_S, LENS, telemetry(np.array([1.0, 0.0, 0.0]), np.full(29, 0.01)))
    assert np.isfinite(blur_px[:29]).all()
    assert np.isnan(blur_px[29])


@pytest.mark.parametrize("missing", [GYROSCOPE, EXPOSURE])
def test_without_samples_no_blur_is_known(missing: str) -> None:
    whole = telemetry(np.ones(3), np.full(30, 0.01))
    streams = {key: value for key, value in whole.streams.items() if key != missing}
    assert predicted_blur_px(FRAMES_S, LENS, CameraTelemetry(streams=streams)) is None


@pytest.mark.parametrize(
    ("blur_px", "best"), [((9.0, 3.0, 6.0), 1), ((0.4, 0.2, 1.0), 2), ((np.nan, np.nan, np.nan), 2)]
)
def test_the_candidate_with_the_least_blur_is_the_best(blur_px: tuple[float, ...], best: int) -> None:
    image = np.zeros((2, 2), np.uint8)
    candidates = [_Candidate(n, image, float(n), 1.0, None, each) for n, each in enumerate(blur_px)]
    assert max(candidates, key=_Candidate.quality).index == best
