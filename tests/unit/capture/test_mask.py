"""A mask per camera: read, refused with a reason, and kept to by corners and job files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.capture.masks import read_mask
from bodycap_batch.config.job import load_job
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.optical_flow import detect_corners
from bodycap_batch.pipeline.inputs import camera_digest
from bodycap_batch.store.digests import FileDigests
from tests.videos import textured_frame, write_video


def _write(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def test_a_mask_is_read_at_the_size_of_the_picture(tmp_path: Path) -> None:
    image = np.zeros((240, 320), np.uint8)
    image[:, 160:] = 255
    mask = read_mask(_write(tmp_path / "mask.png", image), (640, 480))
    assert mask.shape == (480, 640)
    assert mask[:, 322:].all()
    assert not mask[:, :318].any()


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((480, 480), 255, np.uint8), "aspect ratios differ"),
        (np.zeros((480, 640), np.uint8), "inverted"),
        (None, "cannot be read as a picture"),
    ],
)
def test_a_useless_mask_is_refused_with_its_reason(
    tmp_path: Path, image: np.ndarray | None, reason: str
) -> None:
    path = tmp_path / "mask.png"
    if image is None:
        path.write_bytes(b"cannot be read as a picture")
    else:
        _write(path, image)
    with pytest.raises(CaptureError) as caught:
        read_mask(path, (640, 480))
    assert reason in str(caught.value) + str(caught.value.hint)
    with pytest.raises(CaptureError, match="no such mask"):
        read_mask(tmp_path / "other.png", (640, 480))


def test_corners_keep_to_the_mask() -> None:
    image = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    mask = np.zeros((240, 320), dtype=bool)
    mask[:, :100] = True
    corners = detect_corners(image, 100, 8.0, mask)
    assert len(corners) > 50
    assert corners[:, 0].max() <= 100.0


def test_a_repainted_mask_is_another_input(tmp_path: Path) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(index) for index in range(4)])
    mask = np.full((48, 64), 255, np.uint8)
    _write(tmp_path / "mask.png", mask)
    text = "capture: {cameras: [{name: torso, video: torso.mp4, mask: mask.png}]}\nskeleton: none\n"
    (tmp_path / "job.yaml").write_text(text)
    (tmp_path / "plain.yaml").write_text(text.replace(", mask: mask.png", ""))

    def digest(name: str) -> str:
        capture = load_job(tmp_path / name).capture
        return camera_digest(capture, capture.cameras[0], FileDigests(tmp_path / "digests"))

    capture = open_capture(load_job(tmp_path / "job.yaml").capture)
    assert capture.cameras[0].is_unmasked(np.array([[10.0, 10.0], [63.9, 47.9]])).all()
    first = digest("job.yaml")
    assert first != digest("plain.yaml")
    assert first == digest("job.yaml")
    mask[:, :30] = 0
    _write(tmp_path / "mask.png", mask)
    assert digest("job.yaml") != first
    capture = open_capture(load_job(tmp_path / "job.yaml").capture)
    assert capture.cameras[0].is_unmasked(np.array([[10.0, 10.0], [63.9, 47.9]])).tolist() == [False, True]


def test_what_moves_by_itself_is_left_out_of_its_own_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(index) for index in range(4)])
    (tmp_path / "job.yaml").write_text(
        "capture: {cameras: [{name: torso, video: torso.mp4}]}\nskeleton: none\n"
    )
    camera = open_capture(load_job(tmp_path / "job.yaml").capture).cameras[0]
    assert camera.shows_only_room
    moving = np.zeros((4, 3, 4), dtype=bool)
    moving[2, 0, 3] = True  # the cell at the upper right of the third frame
    camera = replace(camera, moving_regions=moving)
    px = np.array([[63.0, 1.0], [63.0, 47.0], [1.0, 1.0]])
    assert not camera.shows_only_room
    assert camera.is_unmasked(px, 2).tolist() == [False, True, True]
    assert camera.is_unmasked(px, 1).all()
    assert camera.is_unmasked(px).all()
