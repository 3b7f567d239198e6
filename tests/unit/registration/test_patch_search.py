"""Patches of keyframes that are warped to an expected view."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from bodycap_batch.registration.recovery import patch_search
from bodycap_batch.registration.recovery.guided_localisation import _LEVELS


def _rendered(obs_px: Any, pyramid: patch_search.Pyramid, blur_px: tuple[float, float]) -> tuple[Any, Any]:
    count = len(obs_px)
    scene = SimpleNamespace(obs_keyframe=np.zeros(count, dtype=np.int64), obs_px=obs_px)
    patches: Any = SimpleNamespace(scene_map=scene, pyramids={0: pyramid})
    warp = np.tile(np.eye(2), (count, 1, 1))
    blur = np.tile(blur_px, (count, 1))
    return patch_search._render_patches(patches, np.arange(count), warp, blur, _LEVELS[-1], 1.0)


def test_all_patches_of_a_frame_may_come_from_one_blurred_keyframe() -> None:
    rng = np.random.default_rng(0)
    pyramid = patch_search.Pyramid.build(rng.integers(0, 255, (480, 640), dtype=np.uint8))
    # More rows of pixels than OpenCV takes in one call.
    count, side = patch_search._MAX_POINTS, _LEVELS[-1].patch_side
    assert count * patch_search._MAX_BLUR_SAMPLES * side > 2**15
    obs_px = rng.uniform((60, 60), (580, 420), (count, 2))
    images, inside = _rendered(obs_px, pyramid, (40.0, 0.0))
    assert inside.all()
    alone, _ = _rendered(obs_px[-1:], pyramid, (40.0, 0.0))
    np.testing.assert_array_equal(images[-1], alone[0])


def test_a_sharp_patch_is_the_picture_of_the_keyframe() -> None:
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 255, (480, 640), dtype=np.uint8)
    images, inside = _rendered(np.array([[100.5, 80.5]]), patch_search.Pyramid.build(grey), (0.0, 0.0))
    half = _LEVELS[-1].patch_side // 2
    assert inside.all()
    np.testing.assert_array_equal(images[0], grey[80 - half : 81 + half, 100 - half : 101 + half])
