"""Sparse flow, rotation fit and sharpness on images with a known warp."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.model.optical_flow import (
    ImageMotion,
    apply_homography,
    detect_corners,
    estimate_coarse_motion,
    fit_rotation,
    make_coarse_image,
    pixel_scale,
    track_points,
    unit_directions,
)
from bodycap_batch.model.sharpness import sharpness


def _texture(seed: int = 0, width: int = 320, height: int = 240) -> np.ndarray:
    noise = np.random.default_rng(seed).random((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_tracks_follow_a_known_shift_in_colmap_pixels() -> None:
    shift = np.array([3.25, -1.5])
    first = _texture()
    second = cv2.warpAffine(first, np.float32([[1, 0, shift[0]], [0, 1, shift[1]]]), (320, 240))
    corners = detect_corners(first, 200, 8.0)
    inside = ((corners > 25) & (corners < (295, 215))).all(axis=1)
    flow = track_points(first, second, corners[inside])
    assert flow.ok.mean() > 0.95
    # Bilinear warping of 8-bit texture leaves a few hundredths of a pixel.
    error = np.linalg.norm(flow.px[flow.ok] - corners[inside][flow.ok] - shift, axis=1)
    assert np.median(error) < 0.05


def test_corners_use_colmaps_pixel_origin() -> None:
    image = np.zeros((60, 80), np.uint8)
    image[20:40, 30:50] = 255
    corners = detect_corners(image, 10, 5.0)
    # The square's edges lie between pixels: at x = 30 and 50, y = 20 and 40 from the image's corner.
    expected = np.array([[30, 20], [50, 20], [30, 40], [50, 40]], dtype=float)
    distance = np.linalg.norm(corners[:, None] - expected[None], axis=2).min(axis=0)
    assert (distance < 1.0).all()


def test_a_point_whose_surroundings_change_is_dropped() -> None:
    first, second = _texture(0), _texture(1)
    flow = track_points(first, second, detect_corners(first, 100, 8.0))
    assert flow.ok.mean() < 0.2


def _motion(affine: np.ndarray) -> ImageMotion:
    """Return the motion of COLMAP's pixels for an affine transformation (2,3) of OpenCV's pixels."""
    offset = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    return ImageMotion(offset @ np.vstack([affine, [0.0, 0.0, 1.0]]) @ np.linalg.inv(offset), True)


def test_an_expected_motion_carries_tracking_over_a_large_motion() -> None:
    first = _texture(2, 640, 480)
    shift = np.array([150.0, 40.0], np.float32)
    second = cv2.warpAffine(first, np.float32([[1, 0, shift[0]], [0, 1, shift[1]]]), (640, 480))
    corners = detect_corners(first, 100, 12.0)
    corners = corners[((corners > 30) & (corners < (440, 390))).all(axis=1)]
    plain = track_points(first, second, corners)
    expected = _motion(np.array([[1.0, 0.0, shift[0] + 1.0], [0.0, 1.0, shift[1] + 1.0]]))
    guided = track_points(first, second, corners, expected)
    right = np.linalg.norm(guided.px - corners - shift, axis=1) < 0.2
    assert (guided.ok & right).mean() > 0.9
    assert (guided.ok & right).sum() > (
        plain.ok & (np.linalg.norm(plain.px - corners - shift, axis=1) < 0.2)
    ).sum()


def test_a_coarse_motion_starts_every_track_near_its_end() -> None:
    first = _texture(5, 640, 480)
    turn = cv2.getRotationMatrix2D((320.0, 240.0), 3.0, 1.02)
    turn[:, 2] += (35.0, -20.0)
    second = cv2.warpAffine(first, turn, (640, 480))
    corners = detect_corners(first, 200, 12.0)
    found = estimate_coarse_motion(make_coarse_image(first), make_coarse_image(second), corners, 640)
    assert found is not None
    # warpAffine works in OpenCV's pixels.
    expected = (corners - 0.5) @ turn[:, :2].T + turn[:, 2] + 0.5
    assert np.abs(apply_homography(corners, found.homography) - expected).max() < 2.0
    inside = ((expected > 25) & (expected < (615, 455))).all(axis=1)
    flow = track_points(first, second, corners[inside], found, with_check=False)
    error = np.linalg.norm(flow.px - expected[inside], axis=1)[flow.ok]
    assert np.median(error) < 0.05


@pytest.mark.parametrize("degrees", [3.0, 20.0, 60.0])
def test_windows_turn_and_grow_with_the_expected_motion(degrees: float) -> None:
    first = _texture(9, 640, 480)
    turn = cv2.getRotationMatrix2D((320.0, 240.0), degrees, 1.1)
    second = cv2.warpAffine(first, turn, (640, 480))
    corners = detect_corners(first, 200, 12.0)
    arrived = apply_homography(corners, _motion(turn).homography)
    inside = np.flatnonzero(((arrived > 25) & (arrived < (615, 455))).all(axis=1))
    # The expected motion is a pixel and half a degree wrong.
    wrong = cv2.getRotationMatrix2D((320.0, 240.0), degrees + 0.5, 1.1)
    wrong[:, 2] += 1.0
    for with_check in (False, True):
        flow = track_points(first, second, corners[inside], _motion(wrong), with_check=with_check)
        error = np.linalg.norm(flow.px - arrived[inside], axis=1)
        assert flow.ok.mean() > 0.9
        assert np.median(error[flow.ok]) < 0.05
    # An unreliable motion does not turn windows.
    unreliable = ImageMotion(_motion(turn).homography, is_reliable=False)
    turned, not_turned = (
        track_points(first, second, corners[inside], each, with_check=False)
        for each in (_motion(turn), unreliable)
    )
    error, other = (np.linalg.norm(each.px - arrived[inside], axis=1) for each in (turned, not_turned))
    assert np.median(other) > 2.0 * np.median(error)


def test_a_third_of_the_picture_in_one_step_is_found_again() -> None:
    wide = _texture(8, 1000, 600)
    # The camera turns by 220 of 640 px, as a thrown hand's does between two frames.
    first, second = wide[60:540, 100:740], wide[100:580, 320:960]
    corners = detect_corners(first, 100, 12.0)
    found = estimate_coarse_motion(make_coarse_image(first), make_coarse_image(second), corners, 640)
    assert found is not None
    shared = corners[(corners > (240, 60)).all(axis=1)]
    # Half a pixel of the reduced images.
    assert np.abs(apply_homography(shared, found.homography) - shared + (220, 40)).max() < 1.5
    flow = track_points(first, second, shared, found)
    assert flow.ok.mean() > 0.8
    back = apply_homography(apply_homography(shared, found.homography), found.inverse().homography)
    np.testing.assert_allclose(back, shared, atol=1e-2)


def test_a_motion_between_unrelated_images_is_not_sure_and_carries_nothing() -> None:
    first, second = _texture(6, 640, 480), _texture(7, 640, 480)
    corners = detect_corners(first, 100, 12.0)
    assert (
        estimate_coarse_motion(make_coarse_image(first), make_coarse_image(second), corners[:5], 640) is None
    )
    found = estimate_coarse_motion(make_coarse_image(first), make_coarse_image(second), corners, 640)
    assert found is None or not found.is_reliable
    assert track_points(first, second, corners, found).ok.mean() < 0.1


def test_no_points_give_an_empty_flow() -> None:
    flow = track_points(_texture(), _texture(), np.zeros((0, 2), np.float32))
    assert flow.px.shape == (0, 2)
    assert detect_corners(np.full((60, 80), 7, np.uint8), 10, 5.0).shape == (0, 2)


@pytest.mark.parametrize("degrees", [0.5, 10.0, 60.0])
def test_rotation_is_found_despite_a_third_of_moving_points(degrees: float) -> None:
    rng = np.random.default_rng(3)
    first = unit_directions(rng.uniform(-0.7, 0.7, (120, 2)))
    truth = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    second = first @ truth.T
    second[:40] += rng.normal(0, 0.15, (40, 3))
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    error = Rotation.from_matrix(fit_rotation(first, second, iterations=15).T @ truth).magnitude()
    assert np.degrees(error) < 0.1


def test_blur_lowers_sharpness_and_scale_follows_the_image() -> None:
    image = _texture(4)
    assert sharpness(cv2.GaussianBlur(image, (0, 0), 3.0)) < 0.5 * sharpness(image)
    assert pixel_scale(1280, 720) == 2.0
    assert pixel_scale(480, 640) == 1.0
