"""Clips of calibration boards, rendered ray by ray with known intrinsics."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.synthetic.lens import ray_grid

SQUARE_TEXELS = 48
_FINER = 2


def chessboard_picture(columns, rows):
    """Return the picture of a chessboard with that many inner corners; the first square is black."""
    squares = (np.indices((rows + 1, columns + 1)).sum(axis=0) % 2).astype(np.uint8)
    return np.kron(25 + 205 * squares, np.ones((SQUARE_TEXELS, SQUARE_TEXELS), np.uint8)).astype(np.uint8)


def with_margin(picture):
    """Return a board with a margin of white paper, one square wide."""
    return cv2.copyMakeBorder(picture, *[SQUARE_TEXELS] * 4, cv2.BORDER_CONSTANT, value=235)


def board_clip(camera, picture, views, rng, *, whole):
    """Render pictures (H,W) of a board that moves before a camera.

    Args:
        camera: The intrinsics.
        picture: The board with its margin, `SQUARE_TEXELS` per square.
        views: Number of pictures; each shows the board at another position and tilt.
        rng: Random generator of poses and noise.
        whole: True keeps the board inside the picture, False lets its edges leave the picture.
    """
    fine = camera.scaled(camera.width_px * _FINER, camera.height_px * _FINER)
    rays = _rays(fine.model, fine.width_px, fine.height_px, tuple(fine.params.tolist()))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    height, width = picture.shape
    away, nearest = (0.17, 1.5) if whole else (0.3, 0.75)
    out = []
    for index in range(views):
        turn = so3_exp(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3)))
        # Towards nine positions in the picture in turn, as the instructions demand.
        place = away * np.array([index % 3 - 1, 0.8 * (index // 3 % 3 - 1)])
        toward = place * [camera.width_px, camera.height_px]
        middle = camera.unproject(np.array(camera.principal_point_px) + toward[None])[0]
        depth = width / SQUARE_TEXELS * rng.uniform(1.0, 1.5) * nearest * camera.focal_px / camera.width_px
        centre = np.append(middle, 1.0) * depth
        # Intersect each ray with the board's plane. Board coordinates are squares from the board's middle.
        facing = (rays @ turn[:, 2:].astype(np.float32))[:, 0]
        scale = np.float32(turn[:, 2] @ centre) / facing
        texel = rays @ turn[:, :2].astype(np.float32) * scale[:, None] * np.float32(SQUARE_TEXELS)
        texel += np.float32(np.array([width, height]) / 2 - 0.5 - turn[:, :2].T @ centre * SQUARE_TEXELS)
        texel[scale <= 0] = -1e6
        grid = texel.reshape(fine.height_px, fine.width_px, 2)
        image = cv2.remap(picture, grid, None, cv2.INTER_LINEAR, borderValue=110)
        small = cv2.resize(image, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
        noisy = small + 2.0 * rng.standard_normal(small.shape, dtype=np.float32)
        out.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return out


@cache
def _rays(model, width_px, height_px, params):
    """Return viewing rays (H·W,3); clips with the same intrinsics share them."""
    lens = Camera(model=model, width_px=width_px, height_px=height_px, params=params)
    return ray_grid(lens).in_cam.reshape(-1, 3).astype(np.float32)


PINHOLE_LENS = Camera(
    model="OPENCV",
    width_px=640,
    height_px=480,
    params=[430.0, 432.0, 327.0, 236.0, -0.18, 0.05, 0.001, -0.0008],
)
FISHEYE_LENS = Camera(
    model="OPENCV_FISHEYE",
    width_px=640,
    height_px=480,
    params=[270.0, 271.0, 324.0, 238.0, 0.03, -0.01, 0.002, 0.0],
)
