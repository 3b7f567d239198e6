"""Keyframes that contradict the tracks are found, on the correct side of the interval."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, transform_points
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration import RegisteredCamera
from bodycap_batch.registration.poses.misplaced_keyframes import (
    find_misplaced_keyframes,
    map_without_keyframes,
)
from bodycap_batch.registration.poses.pnp import AcceptanceCriteria
from bodycap_batch.registration.recovery.preparation import remove_misplaced_keyframes
from bodycap_batch.registration.tracking.klt import Tracks

_LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
_KEYFRAMES = 12
_STEP = 5
_POINTS = 120
_CRITERIA = AcceptanceCriteria(max_error_px=2.0, min_inliers=15, max_sigma_depth=0.05)


def _walk() -> FloatArray:
    """map_from_cam of keyframes that go sideways along a wall 3 m ahead."""
    return np.array([make_transform(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(_KEYFRAMES)])


def _points() -> FloatArray:
    return np.random.default_rng(0).uniform((-1.0, -1.0, 2.5), (2.0, 1.0, 3.5), (_POINTS, 3))


def _map(moved: IntArray, shift_m: float) -> tuple[Map, Tracks]:
    """A map in which some keyframes are misplaced together with their points, and tracks of the true walk."""
    poses, points = _walk(), _points()
    true_px = np.array([_LENS.project(transform_points(pose, points)) for pose in invert(poses)])
    shift = np.array([0.0, shift_m, 0.0])
    wrong = np.isin(np.arange(_KEYFRAMES), moved)
    poses[wrong, :3, 3] += shift
    keyframe, feature = np.repeat(np.arange(_KEYFRAMES), _POINTS), np.tile(np.arange(_POINTS), _KEYFRAMES)
    scene_map = Map(
        gauge="g",
        cameras={"cam": _LENS},
        keyframe_camera=("cam",) * _KEYFRAMES,
        keyframe_frame=np.arange(_KEYFRAMES) * _STEP,
        map_from_cam=poses,
        points=np.concatenate([points, points + shift]),
        colors=np.zeros((2 * _POINTS, 3), np.uint8),
        point_error_px=np.zeros(2 * _POINTS),
        obs_keyframe=keyframe,
        obs_point=feature + _POINTS * wrong[keyframe],
        obs_feature=feature,
        obs_px=true_px.reshape(-1, 2),
    )
    parts = []
    for first, second in zip(range(_KEYFRAMES - 1), range(1, _KEYFRAMES), strict=True):
        for source, to in ((first, second), (second, first)):
            frame, origin = (np.full(_POINTS, number * _STEP) for number in (to, source))
            parts.append(Tracks(frame, origin, np.arange(_POINTS), true_px[to].astype(np.float32)))
    return scene_map, Tracks.join_and_clear(parts)


@pytest.mark.parametrize("moved", [[5], [4, 5, 6], [0, 1], [10, 11]])
def test_a_misplaced_block_of_keyframes_is_found(moved: list[int]) -> None:
    # 0.2 m at 3 m and 400 px are 27 px: far beyond four limits of 2 px.
    scene_map, tracks = _map(np.array(moved), 0.2)
    assert find_misplaced_keyframes("cam", scene_map, tracks, _CRITERIA).tolist() == moved


def test_slipped_tracks_do_not_make_a_keyframe_misplaced() -> None:
    scene_map, tracks = _map(np.array([], dtype=np.int64), 0.0)
    px = tracks.px.copy()
    gap = (tracks.frame == 5 * _STEP) & (tracks.keyframe == 4 * _STEP)
    gap |= (tracks.frame == 4 * _STEP) & (tracks.keyframe == 5 * _STEP)
    px[gap] += np.random.default_rng(1).normal(0.0, 40.0, (int(gap.sum()), 2)).astype(np.float32)
    slipped = Tracks(tracks.frame, tracks.keyframe, tracks.feature, px)
    assert len(find_misplaced_keyframes("cam", scene_map, slipped, _CRITERIA)) == 0


def test_tracks_that_agree_with_the_keyframe_s_own_pose_do_not_contradict_it() -> None:
    """Half of the tracks slipped; the others agree with the keyframe's own pose."""
    scene_map, tracks = _map(np.array([], dtype=np.int64), 0.0)
    px = tracks.px.copy()
    gap = (tracks.frame == 5 * _STEP) & (tracks.keyframe == 4 * _STEP)
    gap |= (tracks.frame == 4 * _STEP) & (tracks.keyframe == 5 * _STEP)
    half = np.flatnonzero(gap & (tracks.feature % 2 == 0))
    px[half] += np.random.default_rng(1).uniform(40.0, 120.0, (len(half), 2)).astype(np.float32)
    slipped = Tracks(tracks.frame, tracks.keyframe, tracks.feature, px)
    assert len(find_misplaced_keyframes("cam", scene_map, slipped, _CRITERIA)) == 0


def test_a_bent_but_consistent_map_stays() -> None:
    # 0.03 m are 4 px, two limits.
    scene_map, tracks = _map(np.array([4, 5, 6]), 0.03)
    assert len(find_misplaced_keyframes("cam", scene_map, tracks, _CRITERIA)) == 0
    assert len(find_misplaced_keyframes("cam", scene_map, Tracks.join_and_clear([]), _CRITERIA)) == 0
    assert len(find_misplaced_keyframes("other", scene_map, tracks, _CRITERIA)) == 0


def test_the_scale_of_the_map_does_not_change_the_result() -> None:
    scene_map, tracks = _map(np.array([4, 5, 6]), 0.2)
    for factor in (0.1, 10.0):
        poses = scene_map.map_from_cam.copy()
        poses[:, :3, 3] *= factor
        fields = {name: getattr(scene_map, name) for name in scene_map.__dataclass_fields__}
        scaled = Map(**{**fields, "map_from_cam": poses, "points": factor * scene_map.points})
        assert find_misplaced_keyframes("cam", scaled, tracks, _CRITERIA).tolist() == [4, 5, 6]


def test_the_remaining_keyframes_keep_their_observations() -> None:
    scene_map, _ = _map(np.array([5]), 0.2)
    rest = map_without_keyframes(scene_map, np.array([5]))
    assert rest.gauge == scene_map.gauge
    assert rest.keyframe_frame.tolist() == [k * _STEP for k in range(_KEYFRAMES) if k != 5]
    assert len(rest.obs_px) == (_KEYFRAMES - 1) * _POINTS
    kept = rest.points_of("cam", np.array([6 * _STEP, 5 * _STEP]), np.array([7, 7]))
    assert kept.tolist() == [7, -1]


def _registered(tracks: Tracks, gauge: str) -> RegisteredCamera:
    """A camera with its registration."""
    count = _KEYFRAMES * _STEP
    times_ns, none = np.arange(count) * 33_333_333, np.zeros(0, np.int64)
    camera = CaptureCamera(
        name="cam",
        chapters=(),
        camera=_LENS,
        calibrated=True,
        frame_numbers=np.arange(count),
        times_ns=times_ns,
        nominal_fps=30.0,
        rolling_shutter_s=0.0,
    )
    path = Trajectory(
        camera="cam",
        gauge=gauge,
        frame_numbers=np.arange(count),
        times_ns=times_ns,
        gauge_from_cam=np.full((count, 4, 4), np.nan),
        covariance=np.full((count, 6, 6), np.nan),
        status=(FrameStatus.FEW_TRACKS,) * count,
        inliers=np.zeros(count, np.int64),
        error_px=np.zeros(count),
    )
    found = Registration(
        trajectory=path,
        obs_frame=tracks.frame,
        obs_keyframe=tracks.keyframe,
        obs_feature=tracks.feature,
        obs_px=tracks.px,
        wanted_keyframes=none,
        tried_keyframes=none,
    )
    return RegisteredCamera(camera=camera, registration=found)


@pytest.mark.parametrize(("gauge", "left_out"), [("g", [5]), ("another", [])])
def test_keyframes_misplaced_in_a_registration_are_removed_from_the_map(
    gauge: str, left_out: list[int]
) -> None:
    scene_map, tracks = _map(np.array([5]), 0.2)
    # No track starts at a removed keyframe, but tracks of other keyframes pass through its frame.
    through = tracks.keyframe != 5 * _STEP
    tracks = Tracks(*(each[through] for each in (tracks.frame, tracks.keyframe, tracks.feature, tracks.px)))
    selection = KeyframeSelection(
        camera="cam", frames=np.zeros(0, np.int64), frame_count=0, sharpness=np.zeros(0), noise_px=0.2
    )
    rest = remove_misplaced_keyframes(
        scene_map, [_registered(tracks, gauge)], selection, RegistrationOptions()
    )
    assert rest.keyframe_frame.tolist() == [k * _STEP for k in range(_KEYFRAMES) if k not in left_out]
