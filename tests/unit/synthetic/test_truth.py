"""The pose that a picture with motion blur shows."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp, so3_log
from bodycap_batch.synthetic.truth import mean_poses

EXPOSURE_S = 0.01
TIMES_S = np.array([0.1, 0.2, 0.35])


def _turning(times_s: FloatArray) -> FloatArray:
    """Return the poses of a camera that moves and turns with constant velocities."""
    return make_transform(so3_exp(times_s[:, None] * [0.3, -2.0, 1.0]), times_s[:, None] * [1.0, 0.5, -0.2])


def test_a_steady_motion_has_its_pose_at_the_middle_as_mean() -> None:
    mean = mean_poses(_turning, TIMES_S, EXPOSURE_S)
    assert mean == pytest.approx(_turning(TIMES_S), abs=1e-4)


def test_the_shake_of_a_single_instant_nearly_vanishes_in_the_mean() -> None:
    """The pose is off at the middle alone: the picture shows the rest of the exposure."""
    shaken = so3_exp([0.0, 0.002, 0.0])

    def poses_at(times_s: FloatArray) -> FloatArray:
        poses = _turning(times_s)
        at_middle = np.abs(times_s[:, None] - TIMES_S).min(axis=1) < 1e-4
        poses[at_middle, :3, :3] = poses[at_middle, :3, :3] @ shaken
        return poses

    off = so3_log(
        np.swapaxes(mean_poses(poses_at, TIMES_S, EXPOSURE_S)[:, :3, :3], 1, 2) @ _turning(TIMES_S)[:, :3, :3]
    )
    assert np.linalg.norm(off, axis=1).max() < 1e-4
