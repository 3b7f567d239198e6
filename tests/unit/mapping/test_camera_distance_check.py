"""The distances between cameras are checked in a map without a metric scale."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.mapping.validation.camera_distance_check import check_distances, find_best_scale
from bodycap_batch.mapping.validation.epipolar_consistency import (
    PairConsistency,
    check_consistency,
    inconsistent_match_ratio,
)
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.nominal_mounts import camera_reach, nominal_mount
from bodycap_batch.model.scene import Map
from bodycap_batch.model.skeleton_presets import load_skeleton

_LENS = Camera(model="PINHOLE", width_px=64, height_px=48, params=np.array([50.0, 50.0, 32.0, 24.0]))
_KEYFRAMES = 30
_TIMES = {name: np.arange(_KEYFRAMES, dtype=np.int64) * 300_000_000 for name in ("hand", "torso")}
_REACH = {("hand", "torso"): (0.1, 1.0)}


def _walk(units_per_metre: float = 1.0, shift_m: float = 0.0, rows: slice = slice(0, 0)) -> Map:
    """Return a map of a torso that walks at 1 m/s and of a hand; `rows` of the hand are moved."""
    t = _TIMES["hand"] * 1e-9
    torso = np.column_stack([t, 0 * t, 0 * t + 1.2])
    hand = torso + np.column_stack([0.2 * np.sin(2 * t), 0 * t + 0.4, 0 * t - 0.3])
    hand[rows] += (0.0, 0.0, shift_m)
    poses = np.tile(np.eye(4), (2 * _KEYFRAMES, 1, 1))
    poses[:, :3, 3] = units_per_metre * np.concatenate([hand, torso])
    none = np.zeros(0, dtype=np.int64)
    return Map(
        gauge="g",
        cameras={"hand": _LENS, "torso": _LENS},
        keyframe_camera=("hand",) * _KEYFRAMES + ("torso",) * _KEYFRAMES,
        keyframe_frame=np.tile(np.arange(_KEYFRAMES), 2),
        map_from_cam=poses,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_error_px=np.zeros(0),
        obs_keyframe=none,
        obs_point=none,
        obs_feature=none,
        obs_px=np.zeros((0, 2)),
    )


@pytest.mark.parametrize("units_per_metre", [0.1, 1.0, 10.0])
def test_the_result_does_not_depend_on_the_scale(units_per_metre: float) -> None:
    right = check_distances(_walk(units_per_metre), _TIMES, _REACH)
    assert right.is_conclusive
    assert right.within_reach == 1.0
    assert not right.violations.any()
    # A hand 15 m off for four keyframes: 0.5 m and 15 m cannot both lie within a factor of ten.
    wrong = check_distances(_walk(units_per_metre, 15.0, slice(10, 14)), _TIMES, _REACH)
    assert wrong.is_conclusive
    assert np.flatnonzero(wrong.violations).tolist()[:4] == list(range(10, 14))
    assert wrong.to_log() == check_distances(_walk(1.0, 15.0, slice(10, 14)), _TIMES, _REACH).to_log()


def test_one_keyframe_off_is_noise_and_half_of_them_off_is_inconclusive() -> None:
    assert not check_distances(_walk(1.0, 15.0, slice(12, 13)), _TIMES, _REACH).violations.any()
    folded = _walk(1.0, 15.0, slice(0, 15))
    result = check_distances(folded, _TIMES, _REACH)
    assert not result.is_conclusive
    assert not result.violations.any()
    assert "no scale" in str(result.to_log()["reason"])


def test_without_common_instants_the_check_is_inconclusive() -> None:
    later = {"hand": _TIMES["hand"], "torso": _TIMES["torso"] + 10**12}
    assert not check_distances(_walk(), later, _REACH).is_conclusive
    assert not check_distances(replace(_walk(), gauge="h"), _TIMES, {}).is_conclusive


def test_the_best_scale_lies_in_most_intervals() -> None:
    low, high = np.array([0.0, 1.0, 2.0, 9.0]), np.array([3.0, 4.0, 5.0, 10.0])
    middle, share = find_best_scale(low, high)
    assert 2.0 <= middle <= 3.0
    assert share == 0.75


def test_reach_of_the_standard_body() -> None:
    body = load_skeleton("full_body", 1.8)
    roles = {"torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand", "left_arm": "LeftArm"}
    rows = camera_reach(body, [nominal_mount(name, role, body) for name, role in roles.items()])
    far = {(a, b): high for a, b, _, high in rows}
    assert len(rows) == 6
    assert all(0 < low < high for _, _, low, high in rows)
    # The arm span equals the stature; wrists are 11 % inside on either side. Add 15 %, 5 cm and the mounts.
    assert 1.4 < far["left_palm", "right_palm"] < 2.4
    assert far["left_arm", "torso"] < far["left_palm", "torso"] < far["left_palm", "right_palm"]


def test_a_map_that_contradicts_its_pairs_is_refused() -> None:
    pairs = [PairConsistency(0, other, 50, 1.0) for other in range(1, 8)] + [
        PairConsistency(0, other, 50, 0.1) for other in (8, 9, 10)
    ]
    assert inconsistent_match_ratio(pairs) == pytest.approx(0.3)
    assert check_consistency(0.05) is None
    error = check_consistency(inconsistent_match_ratio(pairs))
    assert error is not None
    assert re.search(r"30 % .* look the same", error.message)
