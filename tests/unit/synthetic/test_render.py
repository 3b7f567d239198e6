"""The renderer agrees with OpenCV's projection: corners of a marker appear at their true positions."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic.atlas import Atlas, select_filter
from bodycap_batch.synthetic.lens import ray_grid
from bodycap_batch.synthetic.moving_body import camera_poses_at
from bodycap_batch.synthetic.moving_camera import MovingCamera
from bodycap_batch.synthetic.moving_scene import ROOM, MovingPart, MovingScene
from bodycap_batch.synthetic.sensor import Sensor
from bodycap_batch.synthetic.triangles import Surface, surface_facing, triangles_from_surfaces
from bodycap_batch.synthetic.wearer import Wearer

SQUARES, TEXELS = 6, 40
SIDE_M = 1.2
WIDTH, HEIGHT = 320, 240
FOCAL = 210.0
# Looking along +Z of the world from 1.6 m: x right, y down, as the marker is drawn.
LOOKING = make_transform(np.eye(3), [0.0, 0.0, -1.6])


def _board():
    """Return a checkerboard in the plane z = 0 with its middle at the origin, upright when seen from −z."""
    squares = np.indices((SQUARES, SQUARES)).sum(axis=0) % 2
    grey = np.kron(40 + 170 * squares, np.ones((TEXELS, TEXELS))).astype(np.uint8)
    half = SIDE_M / 2
    return Surface(
        corner=np.array([-half, -half, 0.0]),
        across=np.array([SIDE_M, 0.0, 0.0]),
        down=np.array([0.0, SIDE_M, 0.0]),
        image=np.repeat(grey[..., None], 3, axis=2),
    )


def _corners():
    """Return the world positions (N,3) of the corners between squares."""
    ticks = (np.arange(1, SQUARES) / SQUARES - 0.5) * SIDE_M
    x, y = np.meshgrid(ticks, ticks)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


@pytest.fixture(scope="module")
def board():
    surfaces = [
        _board(),
        surface_facing([0, 0, 1.0], [0, -1, 0], (0.2, 0.2), np.full((9, 9, 3), 90, np.uint8)),
    ]
    atlas = Atlas([surface.image for surface in surfaces])
    return MovingPart(ROOM, triangles_from_surfaces(surfaces, atlas.origins)), atlas


def _image(parts, atlas, world_from_cam, lens=None):
    """Return a sharp image of parts that are all in the world frame."""
    scene = MovingScene(parts, atlas, fine=True)
    poses = np.tile(world_from_cam, (len(parts), 1, 1, 1))
    gain = np.ones(len(scene.triangles.faces), np.float32)
    return scene.sharp(ray_grid(lens or _lens()), poses, gain)[0]


def _image_of(surfaces, world_from_cam):
    atlas = Atlas([surface.image for surface in surfaces])
    return _image([MovingPart(ROOM, triangles_from_surfaces(surfaces, atlas.origins))], atlas, world_from_cam)


def _lens(params=(FOCAL, FOCAL, 160.0, 120.0), model="PINHOLE"):
    return Camera(model=model, width_px=WIDTH, height_px=HEIGHT, params=np.array(params))


def _predicted(world_from_cam, distortion=()):
    """Return the corners projected by OpenCV, in its pixels (the first one's centre is 0, 0)."""
    cam_from_world = invert(world_from_cam)
    matrix = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1.0]])
    turn, _ = cv2.Rodrigues(cam_from_world[:3, :3])
    pixels, _ = cv2.projectPoints(
        _corners(), turn, cam_from_world[:3, 3], matrix, np.array(distortion or [0.0] * 4)
    )
    return pixels[:, 0]


def _found(image, near):
    """Return the corners measured in an image, given positions near them."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    start = np.ascontiguousarray(near[:, None], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    return cv2.cornerSubPix(grey, start, (5, 5), (-1, -1), stop)[:, 0]


def _inside(pixels, border=12):
    low, high = np.array([border, border]), np.array([WIDTH, HEIGHT]) - border
    return ((pixels > low) & (pixels < high)).all(axis=1)


@pytest.mark.parametrize(
    ("turn_deg", "centre_m"),
    [
        ((0, 0, 0), (0.0, 0.0, -1.6)),
        ((0, 25, 10), (-0.7, 0.1, -1.4)),
        ((-20, -10, 75), (0.2, 0.5, -1.3)),
        ((5, 3, -40), (0.0, 0.0, -2.4)),
    ],
)
@pytest.mark.parametrize("distortion", [(), (-0.2, 0.04, 0.002, -0.001)])
def test_marker_corners_appear_where_opencv_projects_them(board, turn_deg, centre_m, distortion):
    pose = make_transform(so3_exp(np.radians(turn_deg)), centre_m)
    lens = _lens((FOCAL, FOCAL, 160.0, 120.0, *distortion), "OPENCV") if distortion else _lens()
    image = _image([board[0]], board[1], pose, lens)
    predicted = _predicted(pose, distortion)
    seen = _inside(predicted)
    assert seen.sum() >= 9
    error = _found(image, predicted[seen]) - predicted[seen]
    # A corner is found to a few hundredths of a pixel; a wrong pixel origin would shift all by half a pixel.
    assert np.abs(error).max() < 0.1
    assert np.abs(error.mean(axis=0)).max() < 0.03


class _Straight:
    """A body that moves along +x at a constant speed, without turning."""

    skeleton = load_skeleton("full_body", 1.75)

    def __init__(self, speed_m_s):
        self.speed = speed_m_s

    def pose(self, t_s):
        joints = len(self.skeleton.joints)
        root = np.column_stack([self.speed * t_s, 0 * t_s, 0 * t_s])
        return root, np.tile(np.eye(3), (len(t_s), joints, 1, 1))


def _renderer(board, speed, **values):
    mount = Mount(camera="hips", role="Hips", joint_from_cam=LOOKING, sigma_rad=0.0, sigma_m=0.0)
    parts, atlas = [board[0]], board[1]
    return MovingCamera(
        motion=_Straight(speed), mount=mount, camera=_lens(), parts=parts, atlas=atlas, **values
    )


def test_motion_blur_is_centred_on_the_timestamp(board):
    renderer = _renderer(board, 3.0, exposure_s=0.02)
    pose = camera_poses_at(renderer.motion, renderer.mount, np.array([0.01]))[0]
    image, sharp = renderer.render(0.01), _image([board[0]], board[1], pose)
    predicted = _predicted(pose)
    # 3 m/s · 0.02 s · 210 px / 1.6 m = 7.9 px of blur; symmetric, so the corners stay.
    assert np.abs(_found(image, predicted) - predicted).max() < 0.15
    slope, slope_sharp = (np.abs(np.diff(i[:, :, 0].astype(float), axis=1)).max() for i in (image, sharp))
    assert slope < 0.3 * slope_sharp


def test_rolling_shutter_exposes_each_row_at_its_own_time(board):
    speed, shutter = 2.0, 0.03
    image = _renderer(board, speed, rolling_shutter_s=shutter).render(0.0)
    still = _predicted(LOOKING)
    # Row r is exposed at x = speed · (r/h − ½) · shutter; points move the other way. Row r's centre is
    # r in OpenCV's pixels, r + ½ in COLMAP's.
    moved = speed * ((still[:, 1] + 0.5) / HEIGHT - 0.5) * shutter
    predicted = still - np.column_stack([moved * FOCAL / 1.6, 0 * moved])
    shift = np.ptp(predicted[:, 0] - still[:, 0])
    assert shift > 3.0  # the corners span 105 of 240 rows: 0.44 · 7.9 px; a flipped sign is 7 px off
    assert np.abs(_found(image, predicted) - predicted).max() < 0.1


def test_near_surfaces_hide_far_ones():
    near = replace(
        _board(),
        corner=np.array([-0.3, -0.3, -0.5]),
        across=np.array([0.6, 0, 0]),
        down=np.array([0, 0.6, 0]),
    )
    near = replace(near, image=np.full((20, 20, 3), 250, np.uint8))
    image = _image_of([_board(), near], LOOKING)
    assert (image[100:140, 140:180] == 250).all()
    # 0.3 m at 1.1 m is 57.3 px from the middle. The border lies inside the 218th pixel, which is a mixture.
    assert (image[120, 160:216] == 250).all()
    assert (image[120, 219:225] < 250).all()


def test_a_pixel_on_an_edge_is_a_mixture():
    bright = surface_facing([0, 0, 0], [0, -1, 0], (2.0, 2.0), np.full((16, 16, 3), 200, np.uint8))
    dark = surface_facing([0, -0.5, 0], [0, -1, 0], (1.0, 1.0), np.full((16, 16, 3), 20, np.uint8))
    looking = make_transform(so3_exp([-np.pi / 2, 0, 0]) @ so3_exp([0, 0, 0.2]), [0.0, -2.5, 0.0])
    image = _image_of([bright, dark], looking)
    values = np.unique(image)
    assert {0, 20, 200} <= set(values.tolist())
    # A slanted border crosses pixels everywhere: mixtures of one, two and three quarters.
    assert {65, 110, 155} <= set(values.tolist())


def test_distant_fine_texture_averages_out():
    stripes = np.zeros((512, 512, 3), np.uint8)
    stripes[:, ::2] = 200
    wall = surface_facing([0, 0, 0], [0, -1, 0], (1.0, 1.0), stripes)
    image = _image_of([wall], make_transform(so3_exp([-np.pi / 2, 0, 0]), [0.0, -6.0, 0.0]))
    inside = image[108:132, 148:172].astype(float)
    # With 15 texels per pixel, stripes of 0 and 200 appear as their mean, up to rounding.
    assert np.abs(inside - 100).max() <= 2


def test_images_in_the_atlas_do_not_mix():
    images = [np.full((h, w, 3), v, np.uint8) for h, w, v in ((5, 70, 10), (64, 3, 130), (33, 33, 250))]
    atlas = Atlas(images)
    for image, origin in zip(images, atlas.origins, strict=True):
        corners = np.array([[0.0, 0.0], [image.shape[1], 0], [0, image.shape[0]], image.shape[1::-1]])
        at = np.ascontiguousarray((origin + corners).T, dtype=np.float32)
        for size in (0.3, 2.0, 11.0, 32.0):
            footprint = np.tile(np.array([[size], [0], [0], [size]], np.float32), (1, 4))
            assert (atlas.sample(at, select_filter(footprint)) == image[0, 0]).all()


def test_noise_has_the_requested_strength_and_differs_between_frames():
    grey = np.full((100, 100, 3), 128, np.uint8)
    sensor = Sensor(4.0, grey.size, np.random.SeedSequence(5))
    first, second = (sensor.record(grey, frame).astype(float) for frame in (0, 1))
    for channel in range(3):
        # 10,000 values give it to 0.7 %; white balance (±6 %) moves it by 1.5 %, rounding by 0.3 %.
        assert first[..., channel].std() == pytest.approx(4.0, rel=0.05)
        assert 118 < first[..., channel].mean() < 138
    # Independent: the correlation of 10,000 pairs scatters by 0.01.
    assert abs(np.corrcoef(first[..., 0].ravel(), second[..., 0].ravel())[0, 1]) < 0.05
    assert (sensor.record(grey, 0) == first).all()
    clean = Sensor(0.0, grey.size, np.random.SeedSequence(5)).record(grey, 0)
    assert len(np.unique(clean.reshape(-1, 3), axis=0)) == 1


def test_the_wearers_arm_appears_at_its_joints():
    skeleton = load_skeleton("full_body", 1.75)
    wearer = Wearer(skeleton, np.random.SeedSequence(1))
    atlas = Atlas(wearer.images)
    joints = np.tile(np.eye(4), (len(skeleton.joints), 1, 1))
    for joint, parent in enumerate(skeleton.parents):
        start = np.zeros(3) if parent < 0 else joints[parent, :3, 3]
        joints[joint, :3, 3] = start + skeleton.offsets_m[joint]
    parts = [MovingPart(joint, shape) for joint, shape in wearer.parts(atlas.origins)]
    # From the front: OpenCV axes with z along +y, x along −x... the body's left is on the right.
    front = make_transform(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), [0.0, -2.5, 1.2])
    scene = MovingScene(parts, atlas, fine=True)
    poses = np.stack([invert(joints[part.joint]) @ front for part in parts])[:, None]
    image, _ = scene.sharp(ray_grid(_lens()), poses, np.ones(len(scene.triangles.faces), np.float32))
    in_cam = (joints[:, :3, 3] - front[:3, 3]) @ front[:3, :3]
    pixels = in_cam[:, :2] / in_cam[:, 2:] * FOCAL + [160.0, 120.0]
    for name in ("LeftForeArm", "RightHand", "Head", "Spine", "LeftLeg"):
        x, y = pixels[skeleton.joints.index(name)].astype(int)
        assert image[y, x].max() > 0, name
    elbow = pixels[skeleton.joints.index("LeftForeArm")].astype(int)
    # 4 cm of radius at 2.5 m are 3.4 px.
    assert image[elbow[1] - 9, elbow[0]].max() == 0
    assert image[elbow[1] + 9, elbow[0]].max() == 0
