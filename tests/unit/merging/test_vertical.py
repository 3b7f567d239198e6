"""The vertical from planes, the walk, the lean of the body and the job, weighed against each other."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.trunk_lean import TrunkOrientation, trunk_orientation
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.posture import is_mostly_walking
from bodycap_batch.merging.reporting.advice import describe_vertical
from bodycap_batch.merging.world.vertical import SceneContext, Vertical, VerticalHypothesis, estimate_vertical
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton_presets import load_skeleton

UP = np.array([0.0, 0.0, 1.0])
TURN = so3_exp([0.4, -0.9, 0.3])
STANDING_M = 1.25


def _box_room(rng):
    """Return points (P,3) of the floor, the ceiling and four walls."""
    low, high = np.array([-3.0, -2.5, 0.0]), np.array([3.0, 2.5, 2.6])
    faces = np.tile(rng.uniform(low, high, (200, 3)), (6, 1, 1))
    for face in range(6):
        faces[face, :, face % 3] = (low, high)[face // 3][face % 3]
    return faces.reshape(-1, 3) + rng.normal(scale=0.005, size=(1200, 3))


def _leaning(rng, forward_deg, share, side_deg=0.0):
    """Return axes (N,3,3) and path (N,3) of a trunk that leans for a ratio of the time."""
    leans = np.arange(200) < share * 200
    pitch, side = (
        np.where(leans, most, 0.0) + rng.normal(scale=4.0, size=200) for most in (forward_deg, side_deg)
    )
    # Left is +X and back +Y: a rotation about +X leans forward.
    axes = so3_exp(np.outer(np.radians(pitch), [1.0, 0.0, 0.0])) @ so3_exp(
        np.outer(np.radians(side), [0.0, 1.0, 0.0])
    )
    return axes, 0.45 * axes[:, :, 2] + [0.0, 0.0, STANDING_M - 0.45]


def _found(axes, path, points, front_known=True, stated=(), walks=False) -> Vertical:
    """Estimate the vertical in a rotated frame."""
    scene = SceneContext(points_m=points @ TURN.T, path_m=path @ TURN.T, standing_m=STANDING_M, walks=walks)
    return estimate_vertical(
        TrunkOrientation(TURN @ axes, front_known), scene, np.random.default_rng(0), stated
    )


def _off_deg(found: Vertical) -> float:
    return float(np.degrees(np.arccos(np.clip(found.up @ TURN @ UP, -1.0, 1.0))))


@pytest.mark.parametrize(
    ("forward_deg", "share"),
    [
        (0, 1.0),
        (40, 0.6),
        (80, 0.3),
        (58, 0.6),
        (75, 0.6),
        (90, 0.6),
        (58, 0.8),
        (90, 0.8),
        (58, 1.0),
        (-30, 1.0),
    ],
)
def test_a_bending_person_does_not_turn_the_room_on_its_side(forward_deg, share):
    rng = np.random.default_rng(1)
    found = _found(*_leaning(rng, forward_deg, share), _box_room(rng))
    assert found.source == "map"
    assert _off_deg(found) < 0.5
    assert found.is_determined()


def _walk(rng, slope_deg):
    """Return axes (N,3,3) and path (N,3) of a trunk that walks 4 m along +X, up a slope."""
    axes, _ = _leaning(rng, 0.0, 1.0)
    ahead = np.linspace(-2.0, 2.0, 200)
    bounce = 0.02 * np.sin(2.0 * np.pi * ahead / 0.7)
    return axes, np.column_stack(
        [ahead, np.zeros(200), STANDING_M + bounce + np.tan(np.radians(slope_deg)) * ahead]
    )


def test_a_level_walk_halves_the_error_of_the_planes():
    rng = np.random.default_rng(1)
    tilted = _box_room(rng) @ so3_exp([0.0, np.radians(1.0), 0.0]).T
    found = _found(*_walk(rng, 0.0), tilted, walks=True)
    assert found.source == "map"
    # Variances in square degrees: 0.5 of the planes, 0.36 of floors, 0.04 of the bounce.
    assert 0.35 < _off_deg(found) < 0.6
    # The planes alone have 0.7 degrees, and still have across the path.
    assert 0.55 < found.sigma_deg < 0.66


def test_a_walk_on_a_ramp_does_not_tilt_the_room():
    rng = np.random.default_rng(1)
    found = _found(*_walk(rng, 6.0), _box_room(rng), walks=True)
    assert found.source == "map"
    assert _off_deg(found) < 0.1


def test_a_room_seen_from_one_side_is_not_turned_on_its_side():
    rng = np.random.default_rng(1)
    room = _box_room(rng)
    # The person faces -Y: no camera sees what is behind, nor the ceiling.
    ahead = room[(room[:, 1] < 0.2) & (room[:, 2] < 2.0)]
    found = _found(*_leaning(rng, 80.0, 0.7), ahead)
    assert found.source == "map"
    assert _off_deg(found) < 0.5


def test_the_body_alone_gives_the_direction_it_bends_from():
    rng = np.random.default_rng(1)
    axes, path = _leaning(rng, 60.0, 0.6)
    found = _found(axes, path, np.zeros((0, 3)), walks=True)
    assert found.source == "body"
    assert found.body_off_deg is None
    # The mean leans by 36 degrees, and the modal direction by 60.
    assert _off_deg(found) < 5.0
    # Half of the 46 degrees (RMS) that the trunk moves, and 15 degrees of the mount.
    assert 20.0 < found.sigma_deg < 35.0


@pytest.mark.parametrize(("forward_deg", "share"), [(0, 1.0), (60, 1.0), (90, 1.0), (-30, 1.0), (90, 0.6)])
def test_a_constant_lean_is_unknown_unless_the_person_walks(forward_deg, share):
    axes, path = _leaning(np.random.default_rng(1), forward_deg, share)
    found = _found(axes, path, np.zeros((0, 3)))
    assert found.source == "body"
    assert 38.0 < found.sigma_deg < 50.0
    assert _off_deg(found) < 2.5 * found.sigma_deg
    assert not found.is_determined()
    assert "because only the posture shows the vertical" in describe_vertical(found)
    if share == 1.0:
        walked = _found(axes, path, np.zeros((0, 3)), walks=True)
        assert walked.sigma_deg == pytest.approx(15.0, abs=0.5)
        assert walked.is_determined()


def test_walking_is_distinguished_from_bending_on_the_spot():
    seconds = np.arange(300) / 30.0
    still = np.zeros(300)
    for path, walks in (
        (np.column_stack([0.9 * seconds, still, 0.02 * np.sin(12.0 * seconds)]), True),
        (np.column_stack([0.2 * np.sin(1.5 * seconds), still, 0.2 * np.cos(1.5 * seconds)]), False),
        (np.column_stack([np.minimum(0.9 * seconds, 2.7), still, still]), False),
    ):
        track = CameraTrack(
            camera="torso",
            bone=0,
            frames=np.arange(300),
            times_ns=np.round(seconds * 1e9).astype(np.int64),
            map_from_cam=make_transform(np.tile(TURN, (300, 1, 1)), path @ TURN.T),
            sigma_rad=np.full(300, 0.005),
            sigma_map=np.full(300, 0.005),
        )
        assert is_mostly_walking(track) == walks


def test_a_wall_and_a_sloping_roof_do_not_tilt_a_level_walk():
    rng = np.random.default_rng(1)
    wall = rng.uniform([3.0, -2.0, 0.0], [3.0, 2.0, 2.5], (300, 3))
    roof = rng.uniform([-3.0, -2.0, 2.5], [3.0, 2.0, 2.5], (300, 3))
    roof[:, 2] -= np.tan(np.radians(30.0)) * roof[:, 1]
    clutter = rng.uniform([-3.0, -2.0, 0.0], [3.0, 2.0, 2.5], (150, 3))
    attic = np.concatenate([wall, roof, clutter]) + rng.normal(scale=0.005, size=(750, 3))
    angle = np.linspace(0.0, 10.0, 300)
    walk = np.column_stack([1.5 * np.sin(angle), 1.2 * np.cos(angle), 1.3 + 0.02 * np.sin(22.0 * angle)])
    axes, _ = _leaning(rng, 0.0, 1.0)
    found = _found(axes, walk, attic, front_known=False)
    assert found.source == "walk"
    assert _off_deg(found) < 0.5
    # Without a walk, the planes give the best vertical.
    assert _found(axes, walk[:20], attic, front_known=False).source == "map"


@pytest.mark.parametrize(("hung_deg", "taken"), [(3.0, "map"), (10.0, "marker board")])
def test_a_stated_vertical_is_selected_and_the_others_are_compared_with_it(hung_deg, taken):
    rng = np.random.default_rng(1)
    room, (axes, path) = _box_room(rng), _leaning(rng, 0.0, 1.0)
    hung = TURN @ so3_exp([np.radians(hung_deg), 0.0, 0.0])
    edges = [
        VerticalHypothesis(source="marker board", up=sign * hung[:, axis], sigma_deg=1.5)
        for axis in (0, 2)
        for sign in (1, -1)
    ]
    found = _found(axes, path, room, stated=edges)
    assert found.source == taken
    assert _off_deg(found) == pytest.approx(0.0 if taken == "map" else hung_deg, abs=0.5)
    off_deg = {
        say.source: np.degrees(np.arccos(np.clip(say.up @ found.up, -1.0, 1.0)))
        for say in reversed(found.alternatives)
    }
    assert off_deg["map" if taken == "marker board" else "marker board"] == pytest.approx(hung_deg, abs=0.5)
    assert "body" in off_deg


@pytest.mark.parametrize(
    ("sigma_deg", "off_deg", "taken"),
    [
        (0.3, 0.5, "accelerometers"),
        (0.3, 40.0, "accelerometers"),
        (2.0, 0.5, "map"),
        (2.0, 40.0, "accelerometers"),
    ],
)
def test_a_measured_vertical_comes_before_the_planes_and_the_board(sigma_deg, off_deg, taken):
    """Planes that agree with it are used if they are more exact."""
    rng = np.random.default_rng(1)
    tilted = TURN @ so3_exp([np.radians(off_deg), 0.0, 0.0]) @ UP
    stated = [
        VerticalHypothesis(source="marker board", up=TURN @ UP, sigma_deg=1.5),
        VerticalHypothesis(source="accelerometers", up=tilted, sigma_deg=sigma_deg),
    ]
    axes, path = _leaning(rng, 40.0, 1.0)
    found = _found(axes, path, _box_room(rng), stated=stated)
    assert found.source == taken
    assert _off_deg(found) == pytest.approx(off_deg if taken == "accelerometers" else 0.0, abs=0.3)
    assert {"marker board", "body"} <= {each.source for each in found.alternatives}
    assert f"estimated from the {taken}" in describe_vertical(found)


def test_a_board_on_the_floor_reveals_an_upside_down_body():
    rng = np.random.default_rng(1)
    axes, path = _leaning(rng, 0.0, 1.0)
    lying = [VerticalHypothesis(source="marker board", up=TURN @ UP, sigma_deg=1.5)]
    found = _found(so3_exp([np.pi, 0.0, 0.0]) @ axes, path, _box_room(rng), stated=lying)
    assert _off_deg(found) < 0.5
    # However unlikely it is by everything that the job does not state.
    assert found.is_determined()
    assert "estimated from the map" in describe_vertical(found)


def test_a_board_hung_at_45_degrees_leaves_two_of_its_edges():
    rng = np.random.default_rng(1)
    axes, path = _leaning(rng, 0.0, 1.0)
    hung = TURN @ so3_exp([0.0, np.radians(45.0), 0.0])
    ups = (-hung[:, 0], hung[:, 2])
    edges = [VerticalHypothesis(source="marker board", up=up, sigma_deg=1.5) for up in ups]
    assert not _found(axes, path, np.zeros((0, 3)), stated=edges).is_determined()


def test_two_equally_likely_directions_are_reported():
    """With planes and an unknown front, a lean of 45 degrees fits two directions."""
    rng = np.random.default_rng(1)
    axes, _ = _leaning(rng, 45.0, 1.0)
    cabin = _box_room(rng) * [1.0, 0.52, 1.0] - [0.0, 0.0, 1.3]  # as wide as high, about the chest
    found = _found(axes, np.zeros((20, 3)), cabin, front_known=False)
    assert not found.is_determined()
    rival = max(found.alternatives, key=lambda say: float(np.arccos(np.clip(say.up @ found.up, -1.0, 1.0))))
    assert rival.negative_log_likelihood - found.negative_log_likelihood == pytest.approx(found.margin_nats)


def test_hanging_limbs_give_up_but_no_front():
    skeleton = load_skeleton("upper_body", 1.75)
    bones = [bone for bone in kinematic_chain(skeleton, {"LeftArm"}) if bone.role == "LeftArm"]
    down = so3_exp([0.0, np.pi / 2.0, 0.0])  # the left arm of the zero pose points along +X
    poses = np.tile(make_transform(TURN @ down, np.zeros(3)), (3, 1, 1, 1))
    body = trunk_orientation(skeleton, bones, poses)
    assert not body.front_known
    assert np.allclose(body.modal_up(), TURN @ UP)
    assert np.allclose(np.linalg.det(body.axes), 1.0)
