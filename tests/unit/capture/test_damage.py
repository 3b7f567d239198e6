"""Videos with damaged data: the damaged frames are found, and all others are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera, open_capture
from bodycap_batch.capture.damage import damage_notes, find_damage_and_copies
from bodycap_batch.config import KeyframeOptions
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.registration.poses.pnp import FramePose
from bodycap_batch.registration.poses.trajectory import build_trajectory
from tests.broken import overwrite
from tests.videos import write_video

COUNT = 60


def opened(path: Path) -> CaptureCamera:
    spec = CaptureConfig(cameras=(CameraConfig(name="torso", video=(path,)),))
    return open_capture(spec, threads=1).cameras[0]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    rng = np.random.default_rng(3)
    texture = rng.integers(0, 255, (60, 80 + COUNT)).astype(np.uint8)
    return write_video(
        tmp_path / "torso.mp4", [texture[:, index : index + 80] for index in range(COUNT)], bframes=False
    )


def flip_bits(path: Path, count: int) -> None:
    """Flip bits in the middle fifth of a video."""
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat") + 4
    rng = np.random.default_rng(0)
    for place, bit in zip(rng.uniform(0.4, 0.6, count), rng.integers(8, size=count), strict=True):
        data[start + int(place * (len(data) - start))] ^= 1 << int(bit)
    path.write_bytes(bytes(data))


def test_a_sound_video_has_no_damaged_frame(video: Path) -> None:
    camera = opened(video)
    assert damage_notes(camera, find_damage_and_copies(camera)[0]) == []


@pytest.mark.parametrize("way", ["bits", "zeroes"])
def test_damaged_frames_are_named_and_the_others_are_used(video: Path, way: str, tmp_path: Path) -> None:
    if way == "bits":
        flip_bits(video, 30)
    else:
        overwrite(video, 0.4, 0.6)
    camera = opened(video)
    damaged = find_damage_and_copies(camera)[0]
    # A fifth of the data is hit. The frames have about the same size.
    assert 3 <= len(damaged) <= 20
    assert damaged[0] >= 15
    assert damaged[-1] <= 45
    (note,) = damage_notes(camera, damaged)
    assert f"{len(damaged)} of {COUNT} frames are damaged" in note
    assert f"between {damaged[0] / 30:.2f} and {damaged[-1] / 30:.2f} s" in note

    selection = select_keyframes(camera, KeyframeOptions(), StageContext(work_dir=tmp_path))
    # A frame that the decoder copied to hide damage, without an error, is left out.
    used = np.arange(COUNT) if selection.pictures is None else selection.pictures.frames
    assert used[selection.damaged].tolist() == damaged.tolist()
    assert not np.isin(used[selection.frames], damaged).any()
    assert (selection.sharpness[selection.damaged] == 0).all()

    known = replace(opened(video), damaged=damaged)
    read = [index for index, _ in known.grey_frames()]
    assert read == np.setdiff1d(np.arange(COUNT), damaged).tolist()
    poses = [FramePose(status=FrameStatus.FEW_TRACKS)] * COUNT
    path = build_trajectory(known.only(selection.pictures), "map", poses[: len(used)], selection)
    assert [each is FrameStatus.DAMAGED for each in path.status] == np.isin(used, damaged).tolist()


def test_a_video_whose_last_frames_are_damaged_ends_at_the_last_sound_frame(
    video: Path, tmp_path: Path
) -> None:
    overwrite(video, 0.8, 1.0)
    camera = opened(video)
    selection = select_keyframes(camera, KeyframeOptions(), StageContext(work_dir=tmp_path))
    assert selection.damaged[-1] == COUNT - 1
    assert selection.frames[-1] == selection.damaged[0] - 1


def test_a_video_without_a_sound_frame_is_refused(video: Path) -> None:
    overwrite(video, 0.0, 1.0)
    with pytest.raises(CaptureError, match="none of its frames can be decoded"):
        opened(video)
