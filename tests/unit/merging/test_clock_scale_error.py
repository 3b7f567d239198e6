"""The sigma of the scale grows with the sigmas of estimated clocks."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.clock_scale_error import scale_sigma_from_clocks
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.camera_clock import CameraClock, ClockSource
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton

SKELETON = load_skeleton("upper_body", 1.75)
BONES = kinematic_chain(SKELETON, {"Spine1", "LeftHand"})
MOUNTS = {
    "torso": nominal_mount("torso", "Spine1", SKELETON),
    "left_palm": nominal_mount("left_palm", "LeftHand", SKELETON),
}
SPEED_M_PER_S, AHEAD_M, ASIDE_M = 1.2, 0.4, 0.3


def track(camera: str, role: str, offset_m: np.ndarray) -> CameraTrack:
    """A camera that moves straight ahead at a constant speed."""
    count = 90
    times_ns = np.round(np.arange(count) * 1e9 / 30).astype(np.int64)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = offset_m + 1e-9 * times_ns[:, None] * [SPEED_M_PER_S, 0.0, 0.0]
    bone = next(index for index, each in enumerate(BONES) if each.role == role)
    sigma = np.full(count, 0.001)
    return CameraTrack(
        camera=camera,
        bone=bone,
        frames=np.arange(count),
        times_ns=times_ns,
        map_from_cam=poses,
        sigma_rad=sigma,
        sigma_map=sigma,
    )


@pytest.mark.parametrize(
    ("source", "sigma_s", "expected"),
    [
        ("motion", 0.05, np.log(np.hypot(AHEAD_M + 0.05 * SPEED_M_PER_S, ASIDE_M) / 0.5)),
        ("sound", 0.002, np.log(np.hypot(AHEAD_M + 0.002 * SPEED_M_PER_S, ASIDE_M) / 0.5)),
        ("stated", 0.05, 0.0),
        ("common", 0.0, 0.0),
    ],
)
def test_the_scale_is_as_uncertain_as_the_distances(
    source: ClockSource, sigma_s: float, expected: float
) -> None:
    tracks = [
        track("torso", "Spine1", np.zeros(3)),
        track("left_palm", "LeftHand", np.array([AHEAD_M, ASIDE_M, 0.0])),
    ]
    clocks = {
        "torso": CameraClock(nominal_fps=30.0),
        "left_palm": CameraClock(nominal_fps=30.0, source=source, sigma_s=sigma_s),
    }
    sigma = scale_sigma_from_clocks(BONES, tracks, MOUNTS, clocks)
    # One of the two directions of the shift is nearer, so the larger change is at most a little larger.
    assert sigma == pytest.approx(abs(expected), rel=0.2, abs=1e-9)
