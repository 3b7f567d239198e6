"""The gyroscope and the readout time from matches of a camera that turns and translates near walls."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.rolling_shutter import row_delay
from bodycap_batch.telemetry import camera_rates
from bodycap_batch.telemetry.camera_rates import relate_gyro
from tests.inertial import Hand, Sensor

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
FPS, FRAMES, READOUT_S = 30.0, 120, 0.015
SENSOR = Sensor()


class Arm(Hand):
    """A camera whose translation follows its rotation, as at the end of a forearm, two metres from walls."""

    def poses(self, times_s: FloatArray) -> FloatArray:
        poses = super().poses(times_s)
        poses[:, :3, 3] += poses[:, :3, :3] @ [0.0, 0.3, 0.1]
        return poses


def seen_px(arm: Hand, points: FloatArray, frame_s: FloatArray) -> FloatArray:
    """Return where points (M,3) are seen by a rolling shutter in frames at times (M,)."""
    px = np.full((len(points), 2), 240.0)
    for _ in range(8):
        pose = arm.poses(frame_s + row_delay(LENS, px) * READOUT_S)
        px = LENS.project(np.einsum("mji,mj->mi", pose[:, :3, :3], points - pose[:, :3, 3]))
        px = np.where(np.isfinite(px), np.clip(px, -2000.0, 2000.0), 240.0)
    return px


def drawn_matches(arm: Hand, times_s: FloatArray) -> FrameMatches:
    """Return matches with a noise of 0.3 px, of which a tenth are wrong."""
    rng = np.random.default_rng(5)
    parts = []
    for frame in range(len(times_s) - 1):
        pose = arm.poses(times_s[frame : frame + 1])[0]
        px = rng.uniform([20, 20], [620, 460], (80, 2))
        rays = np.column_stack([LENS.unproject(px), np.ones(80)])
        points = (rays * rng.uniform(1.0, 3.5, (80, 1))) @ pose[:3, :3].T + pose[:3, 3]
        both = [seen_px(arm, points, np.full(80, times_s[frame + step])) for step in (0, 1)]
        inside = np.all([((px > 0) & (px < (640, 480))).all(axis=1) for px in both], axis=0)
        first, second = (px[inside] + rng.normal(0.0, 0.3, (inside.sum(), 2)) for px in both)
        wrong = rng.random(len(first)) < 0.1
        second[wrong] += rng.uniform(-40, 40, (wrong.sum(), 2))
        parts.append((np.full(len(first), frame), first, second))
    frame, first, second = (np.concatenate(each) for each in zip(*parts, strict=True))
    return FrameMatches(
        camera="arm", frame=frame, first_px=first.astype(np.float32), second_px=second.astype(np.float32)
    )


def camera(times_s: FloatArray, **changes: object) -> SimpleNamespace:
    values = {
        "camera": LENS,
        "times_ns": np.round(times_s * 1e9).astype(np.int64),
        "calibrated": True,
        "rolling_shutter_known": False,
        "rolling_shutter_s": 0.0,
        "may_be_sideways": False,
    }
    return SimpleNamespace(**(values | changes))


@pytest.fixture(scope="module")
def drawn() -> tuple[Arm, FloatArray, FrameMatches]:
    arm = Arm(seed=3, reach_m=0.1, turn_rad=0.5)
    times_s = np.arange(FRAMES) / FPS
    return arm, times_s, drawn_matches(arm, times_s)


def errors(arm: Arm, times_s: FloatArray, rates: camera_rates.GyroRates) -> FloatArray:
    """Return the errors (N-1,) of the rotations between frames, radians."""
    step, known, _ = rates.at_frames(np.round(times_s * 1e9).astype(np.int64))
    rotation = arm.poses(times_s)[:, :3, :3]
    truth = np.swapaxes(rotation[1:], 1, 2) @ rotation[:-1]
    return np.linalg.norm(so3_log(np.swapaxes(truth, 1, 2) @ step), axis=1)[known]


def test_delay_rotation_and_readout_of_a_camera_near_walls(
    drawn: tuple[Arm, FloatArray, FrameMatches], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, times_s, matches = drawn
    telemetry = SENSOR.samples(arm, FRAMES / FPS)
    found = relate_gyro(camera(times_s), matches, telemetry)
    assert found.rates is not None
    assert abs(found.rates.readout_s - READOUT_S) < 2.5 * found.rates.readout_sigma_s
    assert found.rates.readout_sigma_s < 0.001
    late_s = telemetry.gyro.times_s[0] - found.rates.times_s[0]
    assert late_s == pytest.approx(SENSOR.late_s, abs=0.0006)
    with monkeypatch.context() as patch:
        patch.setattr(camera_rates, "fit_to_matches", lambda *_: None)
        plain = relate_gyro(camera(times_s), matches, telemetry)
    assert plain.rates is not None
    # The flow of near walls looks like a rotation; the planes of the matches do not.
    assert np.median(errors(arm, times_s, found.rates)) < 0.5 * np.median(errors(arm, times_s, plain.rates))


def test_a_stated_readout_is_kept(drawn: tuple[Arm, FloatArray, FrameMatches]) -> None:
    arm, times_s, matches = drawn
    telemetry = SENSOR.samples(arm, FRAMES / FPS)
    stated = camera(times_s, rolling_shutter_known=True, rolling_shutter_s=READOUT_S)
    found = relate_gyro(stated, matches, telemetry)
    assert found.rates is not None
    assert (found.rates.readout_s, found.rates.readout_sigma_s) == (READOUT_S, 0.0)


def test_samples_of_another_motion_are_not_used(drawn: tuple[Arm, FloatArray, FrameMatches]) -> None:
    _, times_s, matches = drawn
    other = SENSOR.samples(Hand(seed=11), FRAMES / FPS)
    found = relate_gyro(camera(times_s), matches, other)
    assert found.rates is None
    assert "agree" in found.reason or "stabilised" in found.reason


@pytest.mark.parametrize(("factor", "used"), [(1.0, True), (1.2, False)])
def test_a_lens_without_calibration_is_used_if_it_agrees_with_the_gyroscope(
    drawn: tuple[Arm, FloatArray, FrameMatches], factor: float, used: bool
) -> None:
    arm, times_s, matches = drawn
    params = LENS.params * np.array([factor, factor, 1.0, 1.0])
    lens = replace(LENS, params=params, refine=True)
    samples = SENSOR.samples(arm, FRAMES / FPS)
    found = relate_gyro(camera(times_s, calibrated=False, camera=lens), matches, samples)
    assert (found.rates is not None) == used
    assert used or "focal length" in found.reason
