"""The lens of a camera from tracks, before there is a map."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks import estimate_lens
from tests.unit.tracks.simulated import project, tracks_of_views

WIDTH, HEIGHT, FRAMES, FPS = 640, 480, 60, 30


def camera(model: str, focal_px: float, distortion: float) -> Camera:
    params = np.array([focal_px, WIDTH / 2, HEIGHT / 2, distortion])
    return Camera(model=model, width_px=WIDTH, height_px=HEIGHT, params=params)


def tracks_of(lens: Camera, motion: float = 1.0, readout_s: float = 0.0) -> PointTracks:
    """Return tracks of points of a room, 0.2 px of noise, that a camera sees which turns and moves."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-4, -3, -4), (4, 3, 4), (3000, 3))
    points = points[np.linalg.norm(points, axis=1) > 1.5]

    def seen_at(time_s: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return pixels and visibility of the points, each at an instant of its own (N,)."""
        turn = np.stack([0.5 * np.sin(3 * time_s), 0.9 * np.sin(2 * time_s), 0.2 * np.sin(4 * time_s)], 1)
        centre = np.stack([0.3 * np.sin(2.5 * time_s), 0.1 * np.sin(4 * time_s), 0.2 * time_s], 1)
        in_camera = np.einsum("nji,nj->ni", so3_exp(motion * turn), points - motion * centre)
        return project(lens, in_camera)

    views = []
    for time_s in np.arange(FRAMES) / FPS:
        px, seen = seen_at(np.full(len(points), time_s))
        for _ in range(4 if readout_s else 0):
            rows = np.clip(np.nan_to_num(px[:, 1]) / HEIGHT, 0.0, 1.0) - 0.5
            px, seen = seen_at(time_s + readout_s * rows)
        views.append((px, seen))
    return tracks_of_views(lens, views, rng)


TIMES_NS = (np.arange(FRAMES) * 1e9 / FPS).astype(np.int64)


@pytest.mark.parametrize(
    ("model", "focal_px", "distortion", "readout_s"),
    [("SIMPLE_RADIAL", 560.0, -0.1, 0.02), ("SIMPLE_RADIAL_FISHEYE", 280.0, 0.01, 0.0)],
)
def test_the_lens_of_a_camera_that_turns_is_found_within_its_uncertainty(
    model: str, focal_px: float, distortion: float, readout_s: float
) -> None:
    """A rolling shutter bends the lines of sight. Without its readout time, the error was 10 % at 20 ms."""
    steps = list[tuple[int, int]]()
    tracks = tracks_of(camera(model, focal_px, distortion), readout_s=readout_s)
    found = estimate_lens(tracks, TIMES_NS, lambda done, total: steps.append((done, total)))
    assert found is not None
    assert steps == [(number, len(steps)) for number in range(1, len(steps) + 1)]
    assert found.is_determined
    assert found.lens.model == model
    assert found.focal_sigma < 0.03
    assert abs(np.log(found.lens.focal_px / focal_px)) < 0.01
    assert abs(found.lens.params[3] - distortion) < 0.01
    assert found.error_px < 0.25


def test_a_camera_that_stands_still_shows_no_lens() -> None:
    assert estimate_lens(tracks_of(camera("SIMPLE_RADIAL", 500.0, 0.0), motion=0.01), TIMES_NS) is None
