"""Parts of a path in which a camera that fell off stands still in the room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.still_parts import still_parts
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton

BODY = load_skeleton("upper_body", 1.75)
ROLES = {"torso": "Spine1", "left_palm": "LeftHand", "left_foot": "LeftFoot"}
MOUNTS = {camera: nominal_mount(camera, role, BODY) for camera, role in ROLES.items()}
TIMES_S = np.arange(150) / 30.0
SCALE = 0.5
"""Metres per map unit."""


def _track(camera: str, centres_m: FloatArray, *, turn_deg: float = 0.0, stop_s: float = 9.0) -> CameraTrack:
    """Return a track with the noise of poses that swings by `turn_deg` until `stop_s`."""
    rng = np.random.default_rng(1)
    angle = np.radians(turn_deg) * np.sin(5.0 * np.minimum(TIMES_S, stop_s))
    turns = so3_exp(angle[:, None] * np.array([0.0, 0.0, 1.0]) + rng.normal(scale=0.002, size=(150, 3)))
    return CameraTrack(
        camera=camera,
        bone=0,
        frames=np.arange(150),
        times_ns=np.round(1e9 * TIMES_S).astype(np.int64),
        map_from_cam=make_transform(turns, (centres_m + rng.normal(scale=0.002, size=(150, 3))) / SCALE),
        sigma_rad=np.full(150, 0.002),
        sigma_map=np.full(150, 0.002 / SCALE),
    )


def _path(speed_m_s: float, stop_s: float = 9.0) -> FloatArray:
    return np.outer(speed_m_s * np.minimum(TIMES_S, stop_s), [1.0, 0.0, 0.0])


WALK, STAND = _track("torso", _path(1.0)), _track("torso", _path(0.02))


def test_a_camera_that_fell_off_is_still_from_then_on() -> None:
    fallen = _track("left_palm", _path(1.0, 2.4), turn_deg=10.0, stop_s=2.4)
    still = still_parts([WALK, fallen], MOUNTS, SCALE)["left_palm"]
    # The part begins with a window of half a second.
    assert not still[: round(2.4 * 30)].any()
    assert still[round(3.0 * 30) :].all()


@pytest.mark.parametrize(
    "tracks",
    [
        [WALK, _track("left_palm", _path(1.0))],
        [WALK, _track("left_palm", _path(0.01), turn_deg=1.0)],
        [STAND, _track("left_palm", _path(0.0))],
        [WALK, _track("left_foot", _path(0.0))],
        [replace(WALK, camera="left_palm"), _track("torso", _path(0.0))],
    ],
    ids=["worn", "a hand at a rail", "a person who stands", "a foot on the floor", "no trunk"],
)
def test_a_worn_camera_is_not_still(tracks: list[CameraTrack]) -> None:
    assert still_parts(tracks, MOUNTS, SCALE) == {}
