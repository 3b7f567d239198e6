"""The renderer's rays agree with OpenCV's projection."""

import cv2
import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.synthetic.lens import ray_grid

WIDTH, HEIGHT = 96, 72
HEAD = [70.0, 68.0, 47.0, 37.5]
# The inversion may be off by 1e-8 on the image plane, times the focal length.
TOLERANCE_PX = 70 * 1e-8


def _camera(model, params):
    return Camera(model=model, width_px=WIDTH, height_px=HEIGHT, params=np.array(params))


def _pixels():
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("model", "extra"),
    [
        ("PINHOLE", []),
        ("OPENCV", [-0.25, 0.08, 0.003, -0.002]),
        ("FULL_OPENCV", [0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0.02, -0.01, 0.005]),
    ],
)
def test_rays_project_to_their_pixels_with_opencv(model, extra):
    grid = ray_grid(_camera(model, HEAD + extra))
    assert grid.valid.all()
    fx, fy, cx, cy = HEAD
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])
    points = grid.in_cam.reshape(-1, 3) * 3.0
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(extra or [0.0] * 4))
    assert np.abs(pixels[:, 0] + 0.5 - _pixels()).max() < TOLERANCE_PX


def test_fisheye_rays_project_to_their_pixels_with_opencv():
    extra = [0.03, -0.012, 0.004, -0.001]
    grid = ray_grid(_camera("OPENCV_FISHEYE", [40.0, 39.0, 47.0, 37.5, *extra]))
    matrix = np.array([[40.0, 0, 46.5], [0, 39.0, 37.0], [0, 0, 1.0]])
    # OpenCV projects points in front only.
    front = grid.in_cam[..., 2].reshape(-1) > 0.02
    assert front.mean() > 0.9
    points = grid.in_cam.reshape(-1, 1, 3)[front]
    pixels, _ = cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(extra))
    assert np.abs(pixels[:, 0] + 0.5 - _pixels()[front]).max() < TOLERANCE_PX


def test_rays_are_unit_vectors_with_right_derivatives():
    grid = ray_grid(_camera("OPENCV", [*HEAD, -0.2, 0.05, 0.001, 0.001]))
    assert np.abs(np.linalg.norm(grid.in_cam, axis=-1) - 1).max() < 1e-12
    # Central differences are off the next pixel by half a second derivative: (1/f)² · ½ ≈ 1e-4.
    step = grid.in_cam[:, 1:] - grid.in_cam[:, :-1] - grid.per_px_x[:, :-1]
    assert np.abs(step).max() < 2e-4
    step = grid.in_cam[1:] - grid.in_cam[:-1] - grid.per_px_y[:-1]
    assert np.abs(step).max() < 2e-4


def test_pixels_beyond_the_fold_of_strong_barrel_distortion_are_invalid():
    # r (1 - 0.4 r²) grows until r = 0.913, where it is 0.609: 42.6 px from the centre.
    grid = ray_grid(_camera("SIMPLE_RADIAL", [70.0, 48.0, 36.0, -0.4]))
    radius = np.linalg.norm(_pixels() - [48.0, 36.0], axis=1).reshape(HEIGHT, WIDTH)
    assert grid.valid[radius < 42.0].all()
    assert not grid.valid[radius > 43.2].any()
