"""Frames with exposure and rolling shutter agree with the mean of many images of single instants."""

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.synthetic.camera_renderer import camera_poses_at, joint_poses_at
from bodycap_batch.synthetic.lens import project, ray_grid
from bodycap_batch.synthetic.making import build_renderers, draw_subject, video_renderer
from bodycap_batch.synthetic.moving_camera import MovingCamera
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.triangle_renderer import SceneRenderer, concatenate_triangles

EXPOSURE_S, READOUT_S = 0.012, 0.020
FISHEYE = {"lens": "OPENCV_FISHEYE", "lens_params": (48.0, 48.0, 64.0, 40.0, 0.02, -0.005, 0.0, 0.0)}


def _options(**values):
    return SynthOptions(**{
        "width": 128, "height": 80, "seconds": 4.0, "cameras": ("torso",), "seed": 3, "body_in_view": True,
        "arms_ahead": 1.0, "exposure_s": EXPOSURE_S, "rolling_shutter_s": READOUT_S, **values,
    })  # fmt: skip


def _brute(renderer, t_s, instants, bands):
    """Return the mean of images of many instants; each row shows the instant of its own exposure.

    All rows of a band share one instant. Its image is rendered whole, so that the edges between surfaces at
    the border of a band are complete.
    """
    height = renderer.grid.valid.shape[0]
    total = np.zeros(renderer.grid.in_cam.shape)
    for part in np.array_split(np.arange(height), bands):
        low, high = max(0, part[0] - 2), min(height, part[-1] + 3)
        row_s = ((part.mean() + 0.5) / height - 0.5) * renderer.rolling_shutter_s
        for step in (np.arange(instants) + 0.5) / instants - 0.5:
            at = np.array([t_s + row_s + step * renderer.exposure_s])
            body = renderer.wearer.at(joint_poses_at(renderer.motion, at)[0])
            scene = SceneRenderer(concatenate_triangles(renderer.room, body), renderer.atlas)
            pose = camera_poses_at(renderer.motion, renderer.mount, at)[0]
            image = scene.image(renderer.grid, pose, slice(low, high))
            total[part] += image[part - low]
    return total / instants


@pytest.mark.parametrize("lens", [{}, FISHEYE])
def test_a_frame_is_the_mean_over_the_exposure_of_each_row(lens):
    options = _options(**lens)
    renderer = build_renderers(options, draw_subject(options))[0]
    seen = video_renderer(renderer, options.camera()).render(1.0).astype(float)
    expected = _brute(renderer, 1.0, 5, 13)
    still = replace(renderer, exposure_s=0.0, rolling_shutter_s=0.0).render(1.0).astype(float)
    error = np.abs(seen - expected)
    # The default noise has a standard deviation of 2 grey levels, thus a mean absolute value of 1.6.
    assert error.mean() < 1.2
    assert np.percentile(error, 99) < 12.0
    # A frame without blur and rolling shutter is much worse.
    assert np.abs(still - expected).mean() > 2.0 * error.mean()
    # The shift between the images along each axis, from the difference divided by the slope: least squares.
    slopes = [part[1:-1, 1:-1].ravel() for part in np.gradient(expected, axis=(0, 1))]
    shift = np.linalg.lstsq(np.stack(slopes, axis=1), (seen - expected)[1:-1, 1:-1].ravel(), rcond=None)[0]
    assert np.abs(shift).max() < 0.05


def test_a_frame_of_one_instant_keeps_the_renderer_of_single_instants():
    options = _options(exposure_s=0.0, rolling_shutter_s=0.0)
    renderer = build_renderers(options, draw_subject(options))[0]
    assert video_renderer(renderer, options.camera()) is renderer
    fast = MovingCamera(renderer, options.camera()).render(1.0)
    difference = np.abs(fast.astype(float) - renderer.render(1.0))
    # Texel coordinates are interpolated over 4 px, and cells share filters.
    assert difference.mean() < 0.3


@pytest.mark.parametrize("lens", [{}, FISHEYE])
def test_projecting_the_viewing_rays_gives_the_pixels_back(lens):
    camera = _options(**lens).camera()
    grid = ray_grid(camera, margin_px=3)
    assert grid.valid.shape == (86, 134)
    pixels = project(camera, 2.5 * grid.in_cam.reshape(-1, 3)).reshape(86, 134, 2)
    x, y = np.meshgrid(np.arange(-3, 131) + 0.5, np.arange(-3, 83) + 0.5)
    assert np.abs(pixels - np.stack([x, y], axis=-1))[grid.valid].max() < 1e-6
