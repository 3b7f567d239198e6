"""Readout times from matches of adjacent frames, before a map exists."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.mapping.intrinsics.readout_profile import _estimate, estimate_from_matches
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import so3_exp

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
FRAMES = 80
FRAME_S = 1 / 30
NOISE_PX = 0.3


def wobble(time_s: FloatArray) -> FloatArray:
    """Orientation (N,3,3) of a hand that turns at changing speeds about all axes."""
    phase = 2 * np.pi * time_s
    turn = [0.3 * np.sin(1.1 * phase), 0.5 * np.sin(1.4 * phase + 1.0), 0.3 * np.cos(1.2 * phase)]
    return np.asarray(so3_exp(np.stack(turn, axis=-1)))


def shaking_wobble(time_s: FloatArray) -> FloatArray:
    """The same hand with a shake of one degree, six times a second."""
    phase = 2 * np.pi * time_s
    shake = [0.018 * np.sin(6.0 * phase), 0.018 * np.cos(5.3 * phase), 0 * phase]
    return np.asarray(wobble(time_s) @ so3_exp(np.stack(shake, axis=-1)))


def even_pan(time_s: FloatArray) -> FloatArray:
    """An upright pan at constant speed."""
    return np.asarray(so3_exp(np.stack([0 * time_s, 0.3 * time_s, 0 * time_s], axis=-1)))


def uneven_pan(time_s: FloatArray) -> FloatArray:
    """An upright pan to and fro."""
    return np.asarray(so3_exp(np.stack([0 * time_s, 0.8 * np.sin(8 * time_s), 0 * time_s], axis=-1)))


def film(rotation_at: Any, readout_s: float, seed: int = 1) -> FrameMatches:
    """Matches of far points with noise, a tenth of them wrong."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(1500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    px = []
    for frame in range(FRAMES):
        delay = np.zeros(len(points))
        for _ in range(8):
            rays = np.einsum("mji,mj->mi", rotation_at(frame * FRAME_S + delay), points)
            at = LENS.project(rays)
            delay = (np.nan_to_num(np.clip(at[:, 1] / 480.0, 0, 1), nan=0.5) - 0.5) * readout_s
        inside = np.asarray(((at > 0) & (at < (640, 480))).all(axis=1))
        px.append(np.where(inside[:, None], at + rng.normal(0, NOISE_PX, at.shape), np.nan))
    frames, first, second = [], [], []
    for frame in range(FRAMES - 1):
        rows = np.flatnonzero(np.isfinite(px[frame] + px[frame + 1]).all(axis=1))
        later = px[frame + 1][rows].copy()
        later[::10] = rng.uniform((0, 0), (640, 480), later[::10].shape)
        frames.append(np.full(len(rows), frame))
        first.append(px[frame][rows])
        second.append(later)
    return FrameMatches(
        camera="head",
        frame=np.concatenate(frames),
        first_px=np.concatenate(first).astype(np.float32),
        second_px=np.concatenate(second).astype(np.float32),
    )


def estimated(matches: dict[str, FrameMatches], *, known: bool = False) -> Any:
    """The readout times that are estimated for cameras with these matches."""
    camera = SimpleNamespace(
        camera=LENS,
        times_ns=np.round(np.arange(FRAMES) * FRAME_S * 1e9).astype(np.int64),
        rolling_shutter_known=known,
        may_be_sideways=False,
        nominal_fps=30.0,
        given=None,
    )
    cameras = {name: SimpleNamespace(**vars(camera), name=name) for name in matches}
    capture: Any = SimpleNamespace(camera=lambda name: cameras[name])
    selections: Any = [SimpleNamespace(camera=name, matches=each) for name, each in matches.items()]
    return estimate_from_matches(capture, selections)


@pytest.mark.parametrize("readout_s", [0.005, 0.012, 0.028, -0.015])
def test_the_readout_is_found_without_bias(readout_s: float) -> None:
    found = estimated({"head": film(wobble, readout_s)})["head"]
    assert found.source == "estimated"
    # 0.3 px of noise against shifts of up to 60 px: far below the floor of the standard deviation, which is
    # 0.2 ms and 2.5 % of the readout time. The cost of wrong matches counts as parallax, too: 0.9 ms.
    assert abs(found.seconds - readout_s) < 3.0 * found.sigma_s
    assert abs(found.seconds - readout_s) < 0.0008
    floor_s = np.hypot(0.0002, 0.025 * found.seconds)
    assert floor_s <= found.sigma_s < floor_s + 0.0009


def test_a_shake_does_not_make_the_readout_seem_longer() -> None:
    found = estimated({"head": film(shaking_wobble, 0.018)})["head"]
    # Rates that are shrunk towards their means let it seem 1 ms longer.
    assert found.seconds == pytest.approx(0.018, abs=0.0007)


def test_a_global_shutter_is_none_found() -> None:
    found = estimated({"head": film(wobble, 0.0)})["head"]
    assert (found.seconds, found.source) == (0.0, "none found")
    assert abs(found.best_s) < 0.0005


def test_a_pan_at_constant_speed_tells_no_readout() -> None:
    found = estimated({"head": film(even_pan, 0.02)})["head"]
    assert found.seconds == 0.0
    assert found.source.startswith("not determined")


def test_upright_pans_to_and_fro_tell_the_readout() -> None:
    found = estimated({"head": film(uneven_pan, 0.02)})["head"]
    assert abs(found.seconds - 0.02) < max(3.0 * found.sigma_s, 0.001)


def test_equal_cameras_share_a_readout_that_only_one_of_them_tells() -> None:
    found = estimated({"head": film(wobble, 0.015), "torso": film(even_pan, 0.015, seed=2)})
    assert found["torso"].seconds == found["head"].seconds
    assert abs(found["torso"].seconds - 0.015) < 0.001


def test_equal_lenses_with_different_readouts_are_told_apart() -> None:
    found = estimated({"head": film(wobble, 0.006), "torso": film(wobble, 0.02, seed=2)})
    assert found["head"].seconds == pytest.approx(0.006, abs=0.001)
    assert found["torso"].seconds == pytest.approx(0.02, abs=0.001)


def test_few_and_even_turns_of_a_global_shutter_are_not_determined() -> None:
    found = estimated({"head": film(even_pan, 0.0)})["head"]
    assert found.seconds == 0.0
    assert found.source.startswith("not determined")


def test_a_stated_readout_is_not_estimated() -> None:
    assert estimated({"head": film(wobble, 0.01)}, known=True) == {}


def test_a_cost_that_is_flat_around_its_minimum_still_tells_the_readout() -> None:
    rng = np.random.default_rng(2)
    best_s = 0.020 + 0.0005 * rng.standard_normal(90)

    class Profile:
        """Within 2 ms of the best readout time, the cost of each pair of frames is the same."""

        times_ns = np.arange(91) * 33_333_333

        def pair_costs(self, readout_s: float) -> FloatArray:
            return 10.0 + np.maximum(1e3 * np.abs(readout_s - best_s) - 2.0, 0.0) ** 2

        def speeds(self) -> FloatArray:
            return np.arange(90) % 7.0

    profile: Any = Profile()
    found = _estimate([profile])
    assert found.seconds == pytest.approx(0.020, abs=0.001)
    assert 0.0005 < found.sigma_s < 0.004
