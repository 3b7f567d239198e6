"""Matching and verification of pairs of keyframes with synthetic features."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.mapping.matching.pair_matching import KeyframeFeatures, find_mutual_matches, verify_pair
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp, so3_log

_LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
_NONE = np.zeros((0, 128), np.uint8)


def _unit_bytes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return descriptors of length 512, like those of the feature extraction."""
    raw = rng.exponential(1.0, (count, 128))
    return np.round(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.float32)


def test_features_seen_twice_are_matched_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    shared, only_first, only_second = (_unit_bytes(rng, 60) for _ in range(3))
    noisy = np.clip(shared + rng.integers(-3, 4, shared.shape), 0, 255).astype(np.float32)
    found = find_mutual_matches(np.concatenate([only_first, shared]), np.concatenate([noisy, only_second]))
    assert found.tolist() == [[60 + row, row] for row in range(60)]


def test_an_ambiguous_feature_is_left_out() -> None:
    rng = np.random.default_rng(1)
    first = _unit_bytes(rng, 40)
    twice = np.concatenate([first, first[:10]])
    found = find_mutual_matches(first, twice)
    assert sorted(found[:, 0]) == list(range(10, 40))


def test_of_two_features_equally_near_to_a_third_the_first_is_matched() -> None:
    rng = np.random.default_rng(4)
    second = _unit_bytes(rng, 40)
    first = np.concatenate([second[:1], second])
    found = find_mutual_matches(first, second)
    assert found.tolist() == [[0, 0], *([row + 1, row] for row in range(1, 40))]


def test_the_order_of_sums_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    first, second = _unit_bytes(rng, 50), _unit_bytes(rng, 50)
    backwards = first[:, ::-1].copy() @ second[:, ::-1].copy().T
    assert (first @ second.T == backwards).all()


def _two_views(
    rng: np.random.Generator, *, calibrated: bool
) -> tuple[KeyframeFeatures, KeyframeFeatures, IntArray, int]:
    """Return two views 0.5 apart with 100 right matches (half a pixel of noise), then 100 wrong ones."""
    points = rng.uniform((-2, -1.5, 3), (2, 1.5, 6), (100, 3))
    turned = points @ so3_exp(np.array([0.02, 0.15, -0.03])).T + (0.5, 0.05, 0.1)
    pixels = [_LENS.project(each) + rng.normal(0, 0.5, (100, 2)) for each in (points, turned)]
    stray = rng.uniform((0, 0), (640, 480), (2, 100, 2))
    views = [_view(np.concatenate([px, more]), calibrated) for px, more in zip(pixels, stray, strict=True)]
    return views[0], views[1], np.column_stack([np.arange(200)] * 2), 100


def _view(pixels: FloatArray, calibrated: bool) -> KeyframeFeatures:
    rays = _LENS.unproject(pixels) if calibrated else pixels
    return KeyframeFeatures(
        descriptors=_NONE, rays=rays, error=4 / 420 if calibrated else 4.0, calibrated=calibrated
    )


@pytest.mark.parametrize("calibrated", [True, False])
def test_verification_keeps_the_matches_of_one_motion(calibrated: bool) -> None:
    a, b, matches, right = _two_views(np.random.default_rng(3), calibrated=calibrated)
    found = verify_pair(matches, a, b)
    kept = found.matches
    # 4 px is 8 sigma, so no right match is lost. A wrong match lies in a band of 8 of 480 px with a
    # probability of 2 %; 12 of 100 would be five sigma above that.
    assert set(range(right)) <= set(kept[:, 0].tolist())
    assert len(kept) <= right + 12
    assert kept.tolist() == verify_pair(matches, a, b).matches.tolist()
    if found.b_from_a is None:
        assert not calibrated
        return
    error = so3_log(found.b_from_a[:, :3] @ so3_exp(np.array([0.02, 0.15, -0.03])).T)
    direction = np.array([0.5, 0.05, 0.1]) / np.linalg.norm([0.5, 0.05, 0.1])
    assert np.linalg.norm(error) < np.deg2rad(2.0)
    assert found.b_from_a[:, 3] @ direction > np.cos(np.deg2rad(5.0))


def test_unrelated_views_are_not_verified() -> None:
    a, b, matches, right = _two_views(np.random.default_rng(4), calibrated=True)
    # The best of 400 essential matrices explains a dozen or two of 100 wrong matches, never all.
    assert len(verify_pair(matches[right:], a, b).matches) < 40
    assert len(verify_pair(matches[:14], a, b).matches) == 0


def test_a_calibrated_and_an_uncalibrated_camera_are_verified_in_pixels() -> None:
    a, _, matches, right = _two_views(np.random.default_rng(3), calibrated=True)
    _, b, _, _ = _two_views(np.random.default_rng(3), calibrated=False)
    kept = verify_pair(matches, a, b).matches
    assert set(range(right)) <= set(kept[:, 0].tolist())
    assert len(kept) <= right + 12


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_fit_that_fails_inside_opencv_verifies_nothing(
    calibrated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        cv2.resize(np.zeros((0, 0), dtype=np.uint8), (4, 4))  # a failed assertion, as the fit's own is

    a, b, matches, _ = _two_views(np.random.default_rng(3), calibrated=calibrated)
    monkeypatch.setattr(cv2, "findEssentialMat" if calibrated else "findFundamentalMat", failing)
    assert len(verify_pair(matches, a, b).matches) == 0


@pytest.mark.parametrize("calibrated", [True, False])
def test_few_matches_need_few_samples(calibrated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "findEssentialMat" if calibrated else "findFundamentalMat"
    fit = getattr(cv2, name)
    trials: list[int] = []

    def recording(*arguments: Any) -> Any:
        trials.append(arguments[-1])
        return fit(*arguments)

    monkeypatch.setattr(cv2, name, recording)
    a, b, matches, right = _two_views(np.random.default_rng(5), calibrated=calibrated)
    wrong = matches[right:]
    assert len(verify_pair(wrong[:16], a, b).matches) < 16
    verify_pair(wrong, a, b)
    # If 15 of 16 matches are correct, one sample in 1.4 (five matches) or 1.6 (seven) is correct.
    assert trials[0] <= 40
    assert trials[1] == 400


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("wrong", [1, 5, 10])
def test_a_pair_with_few_correct_matches_is_verified(calibrated: bool, wrong: int) -> None:
    for seed in range(20):
        a, b, matches, right = _two_views(np.random.default_rng(100 + seed), calibrated=calibrated)
        few = np.concatenate([matches[:20], matches[right : right + wrong]])
        # All of the 20 correct matches are within 8 sigma, and 15 are enough.
        assert len(verify_pair(few, a, b).matches) >= 15
