"""A recording in fragments and a Matroska file that a power loss cut."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bodycap_batch.capture.decoding import decode_frames
from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.cli import main
from bodycap_batch.core.arrays import IntArray

pytestmark = pytest.mark.data

WHOLE_FRAMES = 60
"""Number of whole frames in each of the two files."""


@pytest.mark.parametrize("name", ["torso.mp4", "torso.mkv"])
def test_the_video_is_used_up_to_its_last_whole_frame(
    data_root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    case = data_root.parent / "cases" / "fragmented_cut"
    if not case.is_dir():
        pytest.skip(f"no case in {case}")
    (tmp_path / "walk").mkdir()
    shutil.copyfile(case / name, tmp_path / "walk" / name)
    video = index_video(tmp_path / "walk" / name)
    assert len(video.pts) == WHOLE_FRAMES
    indices: IntArray = video.pts.searchsorted(video.pts)
    frames = list(decode_frames(video, indices, 1))
    assert len(frames) == WHOLE_FRAMES
    assert not any(frame.is_corrupt for _, frame in frames)
    assert main(["check", str(tmp_path / "walk"), "--out", str(tmp_path / "out")]) == 0
    text = capfd.readouterr().out
    assert f"{WHOLE_FRAMES} frames, 2.0 s" in text
    assert f"note: {name}: its end is missing: " in text
    assert "up to its last whole frame, at 1.97 s" in text
