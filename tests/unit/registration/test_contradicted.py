"""The poses around keyframes that contradict the map are withdrawn."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.model.scene import FrameStatus, Registration, Trajectory
from bodycap_batch.registration import withdraw_contradicted_poses
from bodycap_batch.registration.poses.contradicted import _frames_in_blocks, find_folded_poses
from tests.scenes import small_map


@pytest.mark.parametrize(
    ("misplaced", "expected"),
    [
        ([], []),
        ([15], []),
        ([14, 15], list(range(11, 20))),
        ([15, 25], []),
        ([32, 35], list(range(31, 40))),
        ([2, 3], list(range(10))),
        # A keyframe that the map still contains is in the block too.
        ([14, 15, 20], list(range(11, 30))),
    ],
)
def test_a_block_lies_between_two_keyframes_of_the_map(misplaced: list[int], expected: list[int]) -> None:
    kept = np.array([10, 20, 30])
    inside = _frames_in_blocks(40, kept, np.array(misplaced, dtype=np.int64))
    assert np.flatnonzero(inside).tolist() == expected


def _registration(gauge: str) -> Registration:
    """Return the registration of a camera whose frames 0 to 11 have a pose, except frame 6."""
    poses = np.tile(np.eye(4), (12, 1, 1))
    covariance = np.tile(np.eye(6), (12, 1, 1))
    poses[6], covariance[6] = np.nan, np.nan
    none = np.zeros(0, np.int64)
    return Registration(
        trajectory=Trajectory(
            camera="torso",
            gauge=gauge,
            frame_numbers=np.arange(12),
            times_ns=np.arange(12) * 10**8,
            gauge_from_cam=poses,
            covariance=covariance,
            status=tuple(FrameStatus.BLUR if frame == 6 else FrameStatus.REGISTERED for frame in range(12)),
            inliers=np.full(12, 50),
            error_px=np.full(12, 0.5),
        ),
        obs_frame=none,
        obs_keyframe=none,
        obs_feature=none,
        obs_px=np.zeros((0, 2), np.float32),
        wanted_keyframes=none,
        tried_keyframes=none,
    )


def test_frames_in_a_block_lose_their_poses_and_say_why() -> None:
    scene = small_map()  # The keyframes of the torso's camera are 0, 4 and 8.
    found = withdraw_contradicted_poses(_registration(scene.gauge), [scene], (5, 7)).trajectory
    contradicted = [frame for frame, status in enumerate(found.status) if status is FrameStatus.CONTRADICTED]
    assert contradicted == [5, 7]
    assert found.status[6] is FrameStatus.BLUR
    assert np.flatnonzero(~found.localised).tolist() == [5, 6, 7]


@pytest.mark.parametrize(("gauge", "misplaced"), [("map-0", ()), ("map-0", (5,)), ("another", (5, 7))])
def test_other_registrations_are_not_changed(gauge: str, misplaced: tuple[int, ...]) -> None:
    registration = _registration(gauge)
    assert withdraw_contradicted_poses(registration, [small_map()], misplaced) is registration


def test_poses_after_a_turn_that_the_video_does_not_show_are_contradicted() -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[8:, :3, :3] = so3_exp([0.0, np.pi / 2, 0.0])
    poses[5] = np.nan
    still = RotationChain(
        frames=np.arange(12), turns=np.zeros((11, 3)), sigma_rad=np.full(11, 1e-3), turn_sigma=0.05
    )
    assert np.flatnonzero(find_folded_poses(still, poses)).tolist() == [8, 9, 10, 11]
    assert not find_folded_poses(None, poses).any()
