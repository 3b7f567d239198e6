"""Options of drawn captures: less texture, identical parts of rooms, light, compression, hands in view."""

from functools import cache

import cv2
import numpy as np
import pytest

from bodycap_batch.formats.mp4_writer import VideoWriter
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.synthetic.lens import ray_grid
from bodycap_batch.synthetic.making import draw_subject
from bodycap_batch.synthetic.moving_body import camera_poses_at, joint_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.raycast import NOTHING, RayScene
from bodycap_batch.synthetic.room import build_room
from bodycap_batch.synthetic.sensor import AutoExposure, Sensor
from bodycap_batch.synthetic.triangles import triangles_from_surfaces
from bodycap_batch.synthetic.wearer import Wearer

SMALL = {"width": 64, "height": 48, "seconds": 8.0, "body_in_view": True, "mount_sigma_m": 0.01}


@cache
def _room(**options):
    surfaces = build_room((1.8, 1.5), 10.0, np.random.SeedSequence(1), SynthOptions(**options))
    return [surface for surface in surfaces if not surface.shines]


def test_texture_fades_furniture_and_takes_pictures_away():
    roughness, count = [], []
    for texture in (1.0, 0.3):
        surfaces = _room(texture=texture)
        large = [surface.image for surface in surfaces if min(surface.image.shape[:2]) > 10]
        roughness.append(np.mean([np.abs(np.diff(image.astype(float), axis=1)).mean() for image in large]))
        count.append(len(surfaces))
    assert roughness[0] > 2.0 * roughness[1]
    assert count[0] > count[1]


@pytest.mark.parametrize(("repeats", "quarters"), [("bays_90", 1), ("bays_180", 2), ("two_rooms", 2)])
def test_a_turned_room_is_the_same_room(repeats, quarters):
    surfaces = _room(room=repeats)
    turn = np.linalg.matrix_power(np.array([[0.0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]]), quarters)
    frames = np.array([[each.corner, each.across, each.down] for each in surfaces])
    turned = frames @ turn.T
    upright = np.abs(frames[:, 2, 2]) > 1e-6
    assert upright.sum() > 30
    for frame, surface in zip(turned[upright], np.array(surfaces, object)[upright], strict=True):
        distance = np.abs(frames - frame).max(axis=(1, 2))
        twin = surfaces[int(distance.argmin())]
        assert distance.min() < 1e-9
        # The light differs a little: the lamps are not at the same places.
        smooth = [cv2.resize(each.image, (6, 6), interpolation=cv2.INTER_AREA) for each in (surface, twin)]
        assert np.corrcoef(smooth[0].ravel(), smooth[1].ravel())[0, 1] > 0.8 or np.std(smooth[0]) < 12


def test_a_wall_between_two_rooms_has_openings_where_the_walk_passes():
    surfaces = _room(room="two_rooms")
    triangles = triangles_from_surfaces(surfaces, np.zeros((len(surfaces), 2)))
    scene = RayScene(triangles.vertices, triangles.faces)
    heights = [(y, z) for y in (-2.5, -0.7, 0.0, 1.4, 2.5) for z in (1.2, 2.4)]
    rays = np.array([[-0.3, y, z, 1.0, 0.0, 0.0] for y, z in heights], np.float32)
    blocked = scene.is_occluded(rays, 0.6).reshape(-1, 2)
    assert blocked[:, 0].tolist() == [True, False, True, False, True]
    assert blocked[:, 1].all()


def test_bays_along_a_wall_are_shifted_copies():
    surfaces = _room(room="bays_along")
    north = max(each.corners()[:, 1].max() for each in surfaces)
    near = [each for each in surfaces if each.corners()[:, 1].mean() > north - 0.4]
    first = [np.array([each.corner, each.across, each.down]) for each in near]
    shift = np.zeros((3, 3))
    shift[0, 0] = 1.8
    twins = sum(any(np.abs(one + shift - other).max() < 1e-9 for other in first) for one in first)
    # Two of three bays have a twin 1.8 m to the right.
    assert twins > 0.5 * len(first)


def test_automatic_exposure_follows_the_light_with_a_delay():
    dark, bright = (np.full((48, 64, 3), value, np.uint8) for value in (40, 200))
    exposure = AutoExposure(1.0, 1 / 30)
    first = exposure.gain(dark)
    assert first == pytest.approx(118 / 40, rel=1e-6)
    then = [exposure.gain(bright) for _ in range(60)]
    assert then[0] > 0.9 * first
    assert then[-1] == pytest.approx(118 / 200, rel=0.1)
    assert all(np.diff(then) < 0)
    assert AutoExposure(0.0, 1 / 30).gain(dark) == 1.0


def test_gain_multiplies_light_and_noise():
    grey = np.full((100, 100, 3), 50, np.uint8)
    sensor = Sensor(3.0, grey.size, np.random.SeedSequence(5))
    plain, lifted = (sensor.record(grey, 0, gain).astype(float) for gain in (1.0, 2.5))
    assert lifted.mean() == pytest.approx(2.5 * plain.mean(), rel=0.02)
    assert lifted[..., 0].std() == pytest.approx(2.5 * plain[..., 0].std(), rel=0.03)


def test_the_bit_rate_decides_the_size_of_a_video(tmp_path):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (96, 128, 3), dtype=np.uint8) for _ in range(45)]
    sizes = []
    for rate in (0.3, 1.2):
        path = tmp_path / f"{rate}.mp4"
        with VideoWriter(path, 30.0, (128, 96), "high", bit_rate_mbps=rate) as video:
            for image in images:
                video.add(image)
        sizes.append(8e-6 * path.stat().st_size / 1.5)
    assert sizes[0] == pytest.approx(0.3, rel=0.4)
    assert sizes[1] == pytest.approx(1.2, rel=0.4)


def _shares(options, camera, times_s, joints=None):
    """Return the share of a camera's picture that shows the wearer (or some joints' limbs) at each time."""
    subject = draw_subject(options)
    skeleton = subject.motion.skeleton
    mount = next(mount for mount in subject.mounts if mount.camera == camera)
    sides = tuple(side.capitalize() for side in options.carried_s)
    wearer = Wearer(skeleton, np.random.SeedSequence(1), carrying=sides)
    seen = wearer.parts(np.zeros((len(wearer.images), 2)), mount)
    rays = ray_grid(options.camera()).in_cam[::2, ::2].reshape(-1, 3)
    out = []
    for t_s in times_s:
        poses = joint_poses_at(subject.motion, np.array([t_s]))[0]
        cam = camera_poses_at(subject.motion, mount, np.array([t_s]))[0]
        hit = np.zeros(len(rays), bool)
        for joint, shape in seen if joints is None else [seen[index] for index in joints]:
            to_part = np.linalg.inv(poses[joint]) @ cam
            cast = np.concatenate([np.tile(to_part[:3, 3], (len(rays), 1)), rays @ to_part[:3, :3].T], axis=1)
            hit |= RayScene(shape.vertices, shape.faces).first_hit(cast.astype(np.float32))[0] != NOTHING
        out.append(hit.mean())
    return np.array(out)


def test_a_carried_box_is_in_the_picture_while_it_is_carried():
    options = SynthOptions(**SMALL, cameras=("torso", "head"), seed=2, carried_s={"right": (3.0, 5.0)})
    box = _shares(options, "torso", [1.0, 3.5, 4.0, 4.8, 7.0], joints=[-1])
    assert (box[1:4] > 0.02).all()
    assert (box[[0, 4]] < 0.005).all()


@pytest.mark.parametrize("camera", ["left_wrist", "right_wrist"])
def test_a_wrist_camera_sees_the_own_hand_all_the_time(camera):
    options = SynthOptions(**SMALL, cameras=(camera,), seed=4, hand_in_view=0.4)
    shares = _shares(options, camera, np.arange(0.5, 8.0, 1.5))
    assert 0.3 < np.median(shares) < 0.55
    assert shares.min() > 0.2


def test_a_still_person_moves_the_hands_but_not_the_head():
    motion = draw_subject(SynthOptions(**SMALL, cameras=("torso", "head"), seed=3, still=True)).motion
    poses = joint_poses_at(motion, np.arange(0.0, 8.0, 0.1))
    head, left, right = (
        poses[:, motion.skeleton.index_of_role(role)] for role in ("Head", "LeftHand", "RightHand")
    )
    assert np.ptp(head[:, :3, 3], axis=0).max() < 0.03
    turned = rotation_angle_rad(np.swapaxes(head[:1, :3, :3], 1, 2) @ head[:, :3, :3])
    assert np.degrees(turned).max() < 6.0
    assert max(np.ptp(hand[:, :3, 3], axis=0).max() for hand in (left, right)) > 0.15


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"carried_s": {"right": (1.0, 2.0)}}, "without body_in_view"),
        (
            {"carried_s": {"right": (1.0, 2.0)}, "body_in_view": True},
            "would cover the camera on the right hand",
        ),
        (
            {"carried_s": {"right": (2.0, 1.0)}, "body_in_view": True, "cameras": ("head",)},
            "is not after its start",
        ),
        ({"hand_in_view": 0.4, "body_in_view": True}, "no camera on a forearm"),
        ({"still": True, "on_the_spot": True}, "leave out one"),
        ({"still": True, "walk": "gait"}, "only the simple walk"),
        ({"room": "two_rooms", "walk": "gait"}, "needs the simple built-in walk"),
        ({"room": "bays_90", "bare": ("floor",)}, "cannot be used with bare"),
        ({"bit_rate_mbps": 2.0, "quality": "lossless"}, "bit_rate_mbps: cannot be used with quality"),
    ],
)
def test_invalid_options_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        SynthOptions.model_validate(values)
