"""Cameras that are mounted sideways or upside down: selection among four rolls."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.camera_roll import (
    ROLLS_DEG,
    RollSearch,
    has_unknown_roll,
    reference_roll,
    roll_deg,
    search_rolls,
    with_roll,
)
from bodycap_batch.merging.body_calibration.samples import PostureHints
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.reporting.advice import describe_unknown_way_up, describe_vertical
from bodycap_batch.merging.reporting.report import _inverted_cameras_report
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.nominal_mounts import STATED_SIGMA_RAD, nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.stages.walker import ROLES, Walk, make_inputs, make_walk, record

UP = np.array([0.0, 0.0, 1.0])


def _with_rolls(rolls):
    """Return inputs and tracks of a walk with cameras rotated about their optical axes."""
    rng = np.random.default_rng(2)
    walk = make_walk(rng, off_deg=5.0, off_m=0.01)
    mounts = {name: with_roll(mount, rolls.get(name, 0.0)) for name, mount in walk.mounts.items()}
    rotated = replace(walk, mounts=mounts)
    inputs = make_inputs(rotated, [record(rotated, name, rng) for name in ROLES])
    index = {
        bone.role: position for position, bone in enumerate(kinematic_chain(inputs.skeleton, ROLES.values()))
    }
    return inputs, [make_track(inputs, each, index[ROLES[each.camera]]) for each in inputs.trajectories]


def _reference_roll(inputs, tracks, *verticals):
    return reference_roll(inputs.mount_by_camera(), tracks, *verticals)


def _searched(inputs, tracks):
    """Search the rolls of all cameras but the reference camera, with a known vertical."""
    hints = PostureHints(vertical=UP)
    return search_rolls(inputs.skeleton, inputs.mount_by_camera(), tracks, 1.0, hints, lambda: None)


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("upside_down", [("torso", "left_palm", "right_palm"), ("right_palm",), ()])
def test_cameras_upside_down_are_named_with_the_measured_roll(upside_down, given):
    inputs, _ = _with_rolls({})
    priors = [replace(mount, by_name=not given) for mount in inputs.mounts]
    tilt = make_transform(so3_exp(np.array([0.1, -0.05, 0.02])), np.zeros(3))
    solved = [
        replace(turned, joint_from_cam=turned.joint_from_cam @ tilt)
        for mount in inputs.mounts
        for turned in [with_roll(mount, 180.0) if mount.camera in upside_down else mount]
    ]
    for prior, mount in zip(priors, solved, strict=True):
        expected = 180.0 if mount.camera in upside_down else 0.0
        assert abs(roll_deg(prior, mount)) == pytest.approx(expected, abs=3.0)
    report = _inverted_cameras_report(priors, SimpleNamespace(mounts=solved))
    if given or not upside_down:
        assert report is None
        return
    assert sorted(report.rolls_deg) == sorted(upside_down)
    assert ("(all cameras)" in report.says) == (len(upside_down) == len(priors))
    assert "the roll from the usual mount is 179°" in report.says
    assert all(name in report.says for name in upside_down)


def test_it_is_said_if_nothing_shows_which_way_up_a_camera_is_mounted():
    vertical = Vertical(up=UP, source="map", sigma_deg=1.0, body_off_deg=3.0, share=0.9)
    assert describe_vertical(vertical).endswith("(1 sigma)")
    text = describe_vertical(vertical, describe_unknown_way_up("torso"))
    assert "torso is assumed to be mounted upright" in text
    assert "cannot be noticed" in text


@pytest.mark.parametrize(("camera", "roll"), [("left_palm", 90.0), ("right_palm", 180.0)])
def test_the_roll_of_a_palm_camera_is_found(camera, roll):
    inputs, tracks = _with_rolls({camera: roll})
    found = {each.camera: each for each in _searched(inputs, tracks)}
    assert found[camera].chosen_deg == roll
    others = [each for name, each in found.items() if name != camera]
    assert all(each.chosen_deg == 0.0 for each in others)
    assert found[camera].runner_up()[1] > 0.0


@pytest.mark.parametrize("sigma_rad", [STATED_SIGMA_RAD, np.radians(40.0)])
def test_a_stated_orientation_is_not_searched(sigma_rad):
    inputs, tracks = _with_rolls({})
    stated = tuple(replace(mount, sigma_rad=sigma_rad, by_name=False) for mount in inputs.mounts)
    assert not any(has_unknown_roll(mount) for mount in stated)
    assert _searched(replace(inputs, mounts=stated), tracks) == ()


def _own_up(inputs, tracks):
    """Return a function from a roll to the up direction of a trunk with a nominal camera of that roll."""
    mount = inputs.mount_of(tracks[0].camera)

    def own_up(degrees):
        tilted = tracks[0].map_from_cam[:, :3, :3] @ with_roll(mount, degrees).joint_from_cam[:3, :3].T
        own = tilted[:, :, 2].mean(axis=0)
        return own / np.linalg.norm(own)

    return own_up


@pytest.mark.parametrize("roll", [0.0, 90.0, 180.0])
def test_the_reference_camera_is_above_the_hands(roll):
    inputs, tracks = _with_rolls({"torso": roll})
    # Planes agree with any of the four rolls: the up direction of each one is a direction of the room.
    own_up = _own_up(inputs, tracks)
    assert _reference_roll(inputs, tracks, own_up) == roll
    assert own_up(roll) @ UP > 0.9


@pytest.mark.parametrize("roll", [0.0, 90.0, 180.0, 270.0])
def test_hanging_hands_give_the_roll_if_the_surroundings_give_no_vertical(roll):
    inputs, tracks = _with_rolls({"torso": roll})
    own_up = _own_up(inputs, tracks)
    assert _reference_roll(inputs, tracks, lambda _: None, own_up) == roll
    # One hand alone, or an unknown direction of the trunk, decides nothing.
    assert _reference_roll(inputs, tracks[:2], lambda _: None, own_up) == 0.0
    assert _reference_roll(inputs, tracks, lambda _: None) == 0.0


def _record_roles(roles, over_m=None):
    """Return inputs and tracks of these roles, the reference camera first, the others higher by `over_m`."""
    rng, skeleton = np.random.default_rng(4), load_skeleton("full_body", 1.75)
    mounts = {role: nominal_mount(role, role, skeleton) for role in roles}
    walk = Walk(skeleton, mounts)
    inputs = make_inputs(walk, [record(walk, role, rng) for role in roles], mounts=tuple(mounts.values()))
    index = {bone.role: position for position, bone in enumerate(kinematic_chain(skeleton, roles))}
    tracks = [make_track(inputs, each, index[each.camera]) for each in inputs.trajectories]
    if over_m is not None:
        for track in tracks[1:]:
            track.map_from_cam[:, 2, 3] = tracks[0].map_from_cam[:, 2, 3] + over_m
    return inputs, tracks


@pytest.mark.parametrize("role", ["Hips", "Spine"])
def test_hands_at_work_do_not_change_the_roll_of_a_camera_at_the_belt(role):
    inputs, tracks = _record_roles((role, "LeftHand", "RightHand"), over_m=0.18)
    own_up = _own_up(inputs, tracks)
    assert _reference_roll(inputs, tracks, lambda _: None, own_up) == 0.0
    # The same holds if planes agree with any of the four rolls.
    assert _reference_roll(inputs, tracks, own_up) == 0.0


@pytest.mark.parametrize("part", ["Shoulder", "Arm"])
def test_shoulders_above_the_chest_do_not_change_its_roll(part):
    inputs, tracks = _record_roles(("Spine1", f"Left{part}", f"Right{part}"), over_m=0.17)
    assert _reference_roll(inputs, tracks, lambda _: None, _own_up(inputs, tracks)) == 0.0


@pytest.mark.parametrize("roll", [90.0, 180.0])
def test_legs_give_the_roll_of_a_camera_at_the_belt(roll):
    inputs, tracks = _record_roles(("Hips", "LeftHand", "RightHand", "LeftLeg", "RightLeg"))
    turn = with_roll(replace(inputs.mounts[0], joint_from_cam=np.eye(4)), roll).joint_from_cam
    leading = replace(tracks[0], map_from_cam=tracks[0].map_from_cam @ turn)
    turned = [leading, *tracks[1:]]
    assert _reference_roll(inputs, turned, lambda _: None, _own_up(inputs, turned)) == roll


def test_hands_lifted_half_of_the_time_do_not_change_the_roll():
    inputs, tracks = _with_rolls({})
    own_up = _own_up(inputs, tracks)
    lifted = []
    for track in tracks[1:]:
        poses = track.map_from_cam.copy()
        trunk, seen = tracks[0].poses_at(track.times_ns, max_gap_ns=100_000_000)
        late = seen & (track.times_ns > np.median(track.times_ns))
        below = (trunk[late, :3, 3] - poses[late, :3, 3]) @ UP
        poses[late, :3, 3] += 2.0 * below[:, None] * UP
        lifted.append(replace(track, map_from_cam=poses))
    assert _reference_roll(inputs, [tracks[0], *lifted], lambda _: None, own_up) == 0.0


def test_the_runner_up_is_the_best_of_the_rest():
    search = RollSearch("cam", (0.0, -20.0, 3.0, -5.0), 90.0)
    assert search.runner_up() == (270.0, 15.0)
    assert ROLLS_DEG == (0.0, 90.0, 180.0, 270.0)


def test_one_hand_alone_does_not_change_the_roll():
    inputs, tracks = _with_rolls({})
    aside = tracks[0].map_from_cam[:, :3, :3].mean(axis=0)

    def up_of(degrees):
        return None if degrees == 0.0 else aside[:, 0] * (1.0 if degrees == 90.0 else -1.0)

    assert _reference_roll(inputs, tracks[:2], up_of) == 0.0
