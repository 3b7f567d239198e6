"""Hard captures: a hand at the chest, the wearer's arms in view, a bare room."""

import cv2
import numpy as np
import pytest

from bodycap_batch.synthetic.making import build_renderers, draw_subject
from bodycap_batch.synthetic.moving_body import joint_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.room import HEIGHT_M, build_room
from bodycap_batch.synthetic.wearer import Wearer

SMALL = {"width": 64, "height": 48, "seconds": 5.0, "body_in_view": True, "furnished": False}


def _body_ratios(options, camera, times_s):
    """Return the ratio of a camera's picture that the wearer's body covers, at each time."""
    subject = draw_subject(options)
    renderer = next(
        renderer for renderer in build_renderers(options, subject) if renderer.mount.camera == camera
    )
    shares = []
    for t_s in times_s:
        _, poses = renderer._part_from_cam(np.array([t_s]))
        _, hits = renderer.scene.sharp(renderer.grid, poses.transpose(1, 0, 2, 3), renderer._gain(t_s))
        # The first part is the room.
        shares.append(float((renderer.scene.part_of_face[hits.faces] > 0).mean()))
    return np.array(shares)


@pytest.mark.parametrize(
    ("camera", "seed"),
    [
        ("left_palm", 0),
        pytest.param("left_palm", 3, marks=pytest.mark.slow),
        pytest.param("right_palm", 0, marks=pytest.mark.slow),
        ("right_palm", 3),
    ],
)
def test_a_camera_pressed_to_the_chest_sees_the_wearer_alone(seed, camera):
    options = SynthOptions(**SMALL, seed=seed, pressed_s={camera: (2.0, 3.0)})
    shares = _body_ratios(options, camera, [0.5, 2.0, 2.5, 3.0, 4.5])
    assert (shares[1:4] == 1.0).all()
    # Before and after that, the picture shows mostly the room.
    assert (shares[[0, 4]] < 0.3).all()


def test_a_pressed_hand_moves_smoothly_and_changes_nothing_else():
    still = draw_subject(SynthOptions(**SMALL)).motion
    pressed = draw_subject(SynthOptions(**SMALL, pressed_s={"left_palm": (2.0, 3.0)})).motion
    t_s = np.arange(0.0, 5.0, 0.005)
    joints = [joint_poses_at(motion, t_s)[..., :3, 3] for motion in (still, pressed)]
    moved = np.abs(joints[0] - joints[1]).max(axis=(0, 2))
    for name, most in zip(still.skeleton.joints, moved, strict=True):
        assert (most > 0.01) == (name in ("LeftForeArm", "LeftHand")), name
    assert np.abs(joints[0] - joints[1])[t_s < 1.4].max() < 1e-12
    hand = joints[1][:, still.skeleton.joints.index("LeftHand")]
    # A smooth step of 0.5 m in 0.5 s: 5.8 · 0.5 m / (0.5 s)², and at most 20 m/s² from the walk.
    assert np.linalg.norm(np.diff(hand, 2, axis=0), axis=1).max() / 0.005**2 < 32


def test_arms_held_ahead_are_in_view():
    shares = {
        ahead: _body_ratios(
            SynthOptions(**SMALL, seed=4, arms_ahead=ahead), "torso", np.arange(0.0, 5.0, 0.5)
        )
        for ahead in (0.0, 1.0)
    }
    assert shares[0.0].max() < 0.02
    assert np.median(shares[1.0]) > 0.03


def test_hands_turned_inward_see_much_of_the_wearer():
    times_s = np.arange(0.0, 5.0, 0.5)
    shares = {
        degrees: _body_ratios(
            SynthOptions(**SMALL, seed=41, hands_inward_deg=degrees), "left_palm", times_s
        ).mean()
        for degrees in (0.0, 80.0)
    }
    assert shares[0.0] < 0.05
    assert shares[80.0] > 0.2


def test_patterned_clothes_have_many_corners_and_plain_ones_few():
    corners = {}
    for clothes in ("plain", "patterned"):
        options = SynthOptions(**SMALL, seed=41, clothes=clothes)
        skeleton = draw_subject(options).motion.skeleton
        wearer = Wearer(skeleton, np.random.SeedSequence(1), patterned=clothes == "patterned")
        shirt = max(wearer.images, key=lambda image: image.size)
        smooth = cv2.GaussianBlur(cv2.cvtColor(shirt, cv2.COLOR_RGB2GRAY), (0, 0), 2.0)
        corners[clothes] = len(cv2.SIFT.create().detect(smooth))
    assert corners["patterned"] > 5 * max(corners["plain"], 20)


def test_a_bare_room_has_pictures_on_its_walls_only():
    seed = np.random.SeedSequence(1)
    surfaces = build_room((1.0, 1.0), 20.0, seed, SynthOptions(furnished=False, repeated_posters=True))
    hanging = [surface for surface in surfaces[6:] if not surface.shines]
    assert len(hanging) >= 8
    assert {surface.image.shape for surface in hanging} == {(21, 16, 3)}
    assert len({surface.image.tobytes() for surface in hanging}) > 1
    for surface in hanging:
        # Upright on a wall, not on the floor or the ceiling.
        assert abs(surface.normal[2]) < 1e-9


@pytest.mark.parametrize("name", ["ceiling", "floor", "east"])
def test_a_bare_surface_has_only_its_flat_pictures(name):
    seed = np.random.SeedSequence(1)
    surfaces = build_room((1.0, 1.0), 20.0, seed, SynthOptions(bare=(name,), flat_pictures=4))
    normal = {"ceiling": (0, 0, -1), "floor": (0, 0, 1), "east": (-1, 0, 0)}[name]
    place = {"ceiling": HEIGHT_M, "floor": 0.0, "east": surfaces[0].corners()[:, 0].max()}[name]
    axis = int(np.argmax(np.abs(normal)))
    # Everything within 2 cm of the surface that faces the room: the surface itself and its pictures. Carpets
    # lie 1.2 cm above the floor, and pictures hang 1.2 cm before a wall.
    near = [
        surface
        for surface in surfaces
        if np.dot(surface.normal, normal) > 0.99
        and np.abs(surface.corners()[:, axis] - place).max() < 0.02
        and not surface.shines
    ]
    assert len(near) == 5
    whole = max(near, key=lambda surface: np.linalg.norm(np.cross(surface.across, surface.down)))
    assert np.abs(np.diff(whole.image.astype(float), axis=0)).mean() < 3.0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"bare": ("floor", "floor")}, "each surface must occur only once"),
        ({"bare": ("roof",)}, "Input should be 'ceiling'"),
        ({"pressed_s": {"torso": (1.0, 2.0)}, "body_in_view": True}, "no camera torso on a hand"),
        ({"pressed_s": {"left_palm": (2.0, 1.0)}, "body_in_view": True}, "is not after its start"),
        ({"pressed_s": {"left_palm": (1.0, 2.0)}}, "without body_in_view"),
        ({"clothes": "patterned"}, "cannot be seen without body_in_view"),
    ],
)
def test_invalid_options_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        SynthOptions.model_validate(values)
