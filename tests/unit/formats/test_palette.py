"""One colour per camera in all files and images."""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.palette import CAMERA_COLOURS, camera_colours, hex_from_colour
from bodycap_batch.formats.ply import PointCloud, add_camera_paths
from bodycap_batch.preview import PreviewInputs
from bodycap_batch.preview.preview_film import make_tiles
from bodycap_batch.preview.preview_timeline import make_timeline
from bodycap_batch.preview.room_drawing import BACKGROUND
from tests.reports import report_inputs, written
from tests.videos import textured_frame, write_video

SEEN_WITHOUT = {
    "nothing": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "red": (
        (0.152286, 1.052583, -0.204868),
        (0.114503, 0.786281, 0.099216),
        (-0.003882, -0.048116, 1.051998),
    ),
    "green": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.01182, 0.04294, 0.968881)),
    "blue": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.3039)),
}
"""Matrices from linear sRGB to linear sRGB as seen without one kind of cones (Machado et al. 2009)."""
XYZ_OF_WHITE = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def _linear(colour: tuple[int, ...]) -> FloatArray:
    share = np.array(colour) / 255.0
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def _luminance(colour: tuple[int, ...]) -> float:
    """Return the relative luminance of an sRGB colour, as in the Web Content Accessibility Guidelines."""
    return float(_linear(colour) @ (0.2126, 0.7152, 0.0722))


def _lab(linear: FloatArray) -> FloatArray:
    """Convert linear sRGB to CIELAB."""
    xyz = XYZ_OF_WHITE @ linear / XYZ_OF_WHITE.sum(axis=1)
    x, y, z = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("lacking", SEEN_WITHOUT)
def test_any_two_differ_with_a_colour_vision_deficiency(lacking: str) -> None:
    sight = np.array(SEEN_WITHOUT[lacking])
    seen = [_lab(np.clip(sight @ _linear(colour), 0.0, 1.0)) for colour in CAMERA_COLOURS]
    assert min(np.linalg.norm(one - other) for one, other in combinations(seen, 2)) >= 16.0


@pytest.mark.parametrize("colour", CAMERA_COLOURS)
def test_each_has_contrast_on_white_and_on_the_dark_background(colour: tuple[int, int, int]) -> None:
    for ground in ((255, 255, 255), (28, 32, 36), tuple(BACKGROUND.tolist())):
        light, dark = sorted((_luminance(colour), _luminance(ground)), reverse=True)
        assert (light + 0.05) / (dark + 0.05) >= 3.0
    assert re.fullmatch("#[0-9a-f]{6}", hex_from_colour(colour))


def test_the_colour_of_a_camera_depends_only_on_the_names_of_all_cameras() -> None:
    every = camera_colours(["torso", "left_palm", "right_palm"])
    assert every == camera_colours(["right_palm", "torso", "left_palm"])
    assert len(set(camera_colours(f"camera {number}" for number in range(8)).values())) == 8
    nothing = PointCloud(points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    cloud = add_camera_paths(nothing, {"torso": np.zeros((1, 3))}, 0.1, every)
    assert tuple(cloud.colors[0].tolist()) == every["torso"]


def test_page_and_preview_use_these_colours(tmp_path: Path) -> None:
    inputs = report_inputs(frames=30)
    own = camera_colours(inputs.cameras)
    tones = re.search(r'"tones": ?(\{[^}]*\})', written(inputs, tmp_path))
    assert tones is not None
    assert json.loads(tones.group(1)) == {name: hex_from_colour(colour) for name, colour in own.items()}
    for name in ("left_palm", "torso"):
        write_video(tmp_path / "videos" / f"{name}.mp4", [textured_frame(index) for index in range(9)])
    capture = open_capture(load_job(tmp_path / "videos").capture)
    film = PreviewInputs(
        path=tmp_path / "preview.mp4",
        capture=capture,
        views=(),
        reference_frame="map-0",
        points=np.zeros((0, 3)),
        colours=np.zeros((0, 3), np.uint8),
    )
    tiles = make_tiles(film, make_timeline(0, 250_000_000, 30.0))
    assert {tile.camera.name: tile.colour for tile in tiles} == camera_colours(["torso", "left_palm"])
