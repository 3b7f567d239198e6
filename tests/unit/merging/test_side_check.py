"""Detection of swapped left and right cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.body_calibration.camera_roll import with_roll
from bodycap_batch.merging.cameras.side_check import swapped_sides
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.reporting.advice import describe_swapped_sides
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton

ROLES = {
    "torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand", "head": "Head",
    "left_shin": "LeftLeg", "right_shin": "RightLeg",
}  # fmt: skip
BODY = load_skeleton("upper_body", 1.75)
MOUNTS = {camera: nominal_mount(camera, role, BODY) for camera, role in ROLES.items()}
BACK = replace(nominal_mount("torso_back", "Spine1", BODY), camera="torso")
UP = np.array([0.0, 0.0, 1.0])


def _track(camera: str, poses) -> CameraTrack:
    count = len(poses)
    return CameraTrack(
        camera=camera,
        bone=0,
        frames=np.arange(count),
        times_ns=np.arange(count) * 33_000_000,
        map_from_cam=poses,
        sigma_rad=np.full(count, 0.01),
        sigma_map=np.full(count, 0.01),
    )


def _tracks(*sides: tuple[str, float], down_rad: float = 0.0, count: int = 90) -> list[CameraTrack]:
    """Return a trunk's camera that turns round, pitched down, and cameras at distances to its right."""
    headings = np.linspace(0.0, 6.0, count)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turned = so3_exp(headings[:, None] * UP) @ level @ so3_exp(np.array([-down_rad, 0.0, 0.0]))
    trunk = make_transform(turned, np.zeros((count, 3)))
    out = [_track("torso", trunk)]
    for camera, right_m in sides:
        swing = 0.1 * np.sin(np.arange(count) / 5.0)
        away = np.column_stack([right_m + swing, np.full(count, 0.4), np.full(count, 0.2)])
        out.append(_track(camera, trunk @ make_transform(np.tile(np.eye(3), (count, 1, 1)), away)))
    return out


def test_swapped_sides_are_found() -> None:
    wrong = swapped_sides(_tracks(("left_palm", 0.3), ("right_palm", -0.3), ("head", 0.0)), MOUNTS, UP)
    assert wrong == {"left_palm": 1.0, "right_palm": 1.0}
    text = describe_swapped_sides(wrong, all_limbs=True)
    assert text.startswith("left_palm and right_palm stay on the wrong side")
    assert "looks backward" in text


@pytest.mark.parametrize("shins_m", [0.2, 0.02])
def test_swapped_palms_are_found_beside_other_limbs_on_their_own_sides(shins_m: float) -> None:
    palms, shins = (
        (("left_palm", 0.3), ("right_palm", -0.3)),
        (("left_shin", -shins_m), ("right_shin", shins_m)),
    )
    wrong = swapped_sides(_tracks(*palms, *shins), MOUNTS, UP)
    assert wrong == {"left_palm": 1.0, "right_palm": 1.0}
    assert "looks backward" not in describe_swapped_sides(wrong, all_limbs=False)


@pytest.mark.parametrize(
    "tracks",
    [
        _tracks(("left_palm", -0.3), ("right_palm", 0.3)),
        # One arm held across the chest is a posture.
        _tracks(("left_palm", 0.3), ("right_palm", 0.3)),
        _tracks(("left_palm", 0.3), ("right_palm", 0.3), ("left_shin", -0.3), ("right_shin", 0.3)),
        _tracks(("left_palm", 0.3), ("left_shin", -0.3), ("right_shin", 0.3)),
        _tracks(("left_palm", 0.0)),
        _tracks(("head", 0.0)),
        # A camera that looks at the feet does not show where the body faces.
        _tracks(("left_palm", 0.3), ("right_palm", -0.3), down_rad=1.3),
    ],
    ids=[
        "right",
        "one arm across",
        "one arm across, legs",
        "one palm, legs",
        "in the middle",
        "no limb",
        "looking down",
    ],
)
def test_undetermined_sides_are_not_reported(tracks: list[CameraTrack]) -> None:
    assert swapped_sides(tracks, MOUNTS, UP) == {}


def test_an_upside_down_camera_is_not_used() -> None:
    assert swapped_sides(_tracks(("left_palm", 0.3), ("right_palm", -0.3)), MOUNTS, -UP) == {}


@pytest.mark.parametrize("roll_deg", [0.0, 180.0])
def test_a_back_camera_has_the_left_hand_on_its_right(roll_deg: float) -> None:
    own, swapped = (_tracks(("left_palm", side * 0.3), ("right_palm", side * -0.3)) for side in (1.0, -1.0))
    mounts = {**MOUNTS, "torso": with_roll(BACK, roll_deg)}
    turn = so3_exp(np.array([0.0, 0.0, np.radians(roll_deg)]))
    for tracks in (own, swapped):
        poses = tracks[0].map_from_cam.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ turn
        tracks[0] = replace(tracks[0], map_from_cam=poses)
    assert swapped_sides(own, mounts, UP) == {}
    assert swapped_sides(swapped, mounts, UP) == {"left_palm": 1.0, "right_palm": 1.0}


def test_a_reference_camera_on_a_limb_is_not_used() -> None:
    tracks = _tracks(("left_palm", 0.3), ("right_palm", -0.3))
    arm = replace(BACK, role="LeftArm")
    for mount in (arm, replace(MOUNTS["torso"], role="LeftArm")):
        assert swapped_sides(tracks, {**MOUNTS, "torso": mount}, UP) == {}
