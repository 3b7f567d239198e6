"""The lens of a camera from tracks, before there is a map."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks import estimate_lens
from tests.unit.tracks.simulated import project, tracks_of_views

WIDTH, HEIGHT, FRAMES, FPS = 640, 480, 60, 30


def camera(model: str, focal_px: float, distortion: float) -> Camera:
    params = np.array([focal_px, WIDTH / 2, HEIGHT / 2, distortion])
    return Camera(model=model, width_px=WIDTH, height_px=HEIGHT, params=params)


def tracks_of(lens: Camera, motion: float = 1.0) -> PointTracks:
    """Return tracks of points of a room, 0.2 px of noise, that a camera sees which turns and moves."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-4, -3, -4), (4, 3, 4), (3000, 3))
    points = points[np.linalg.norm(points, axis=1) > 1.5]
    views = []
    for time in np.arange(FRAMES) / FPS:
        turn = so3_exp(
            motion * np.array([0.5 * np.sin(3 * time), 0.9 * np.sin(2 * time), 0.2 * np.sin(4 * time)])
        )
        centre = motion * np.array([0.3 * np.sin(2.5 * time), 0.1 * np.sin(4 * time), 0.2 * time])
        views.append(project(lens, (points - centre) @ turn))
    return tracks_of_views(lens, views, rng)


TIMES_NS = (np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)


@pytest.mark.parametrize(
    ("model", "focal_px", "distortion"),
    [("SIMPLE_RADIAL", 560.0, -0.1), ("SIMPLE_RADIAL_FISHEYE", 280.0, 0.01)],
)
def test_the_lens_of_a_camera_that_turns_is_found_within_its_uncertainty(
    model: str, focal_px: float, distortion: float
) -> None:
    found = estimate_lens(tracks_of(camera(model, focal_px, distortion)), TIMES_NS)
    assert found is not None
    assert found.is_determined
    assert found.lens.model == model
    assert found.focal_sigma < 0.06
    assert abs(np.log(found.lens.focal_px / focal_px)) < 3.0 * found.focal_sigma
    assert found.error_px < 0.5


def test_a_camera_that_stands_still_shows_no_lens() -> None:
    assert estimate_lens(tracks_of(camera("SIMPLE_RADIAL", 500.0, 0.0), motion=0.01), TIMES_NS) is None
