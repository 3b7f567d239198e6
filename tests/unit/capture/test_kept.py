"""Frames kept beside the keyframes: the same pictures, without the video."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera, FrameKeeper, open_camera
from bodycap_batch.capture.images import grey_from_planes, work_image, work_planes
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.options import KeyframeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.keyframes import KeyframesTask, run_keyframes
from bodycap_batch.tasks.loading import load_capture, load_keyframes
from tests.videos import write_video

CHOSEN = [0, 3, 4, 11]


def noisy_frames(width: int, height: int, side: int = 8) -> list[np.ndarray]:
    """Twelve frames of coloured squares, no two alike."""
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 256, (12, height // side, width // side, 3)).astype(np.uint8)
    return [frame.repeat(side, axis=0).repeat(side, axis=1) for frame in coarse]


def opened(video: Path, work_px: int = 960) -> CaptureCamera:
    config = CameraConfig(name="torso", video=(video,), calibration="auto")
    return open_camera(CaptureConfig(cameras=(config,), work_px=work_px), config)


def with_kept(camera: CaptureCamera, folder: Path) -> CaptureCamera:
    size = camera.camera
    with FrameKeeper(folder, size.width_px, size.height_px, camera.should_keep_all) as keeper:
        for shot in camera.frame_candidates():
            keeper.add_frame(shot)
            if shot.index in CHOSEN:
                keeper.add_keyframe(shot)
    return replace(camera, kept=keeper.kept_frames())


def both(camera: CaptureCamera, indices: list[int]) -> list[tuple[int, np.ndarray]]:
    return [*camera.read(indices), *camera.read(indices, colour=True)]


def assert_same(first: list[tuple[int, np.ndarray]], second: list[tuple[int, np.ndarray]]) -> None:
    assert [index for index, _ in first] == [index for index, _ in second]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(first, second, strict=True))


@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuvj420p"])
@pytest.mark.parametrize("rotation", [0, 90])
def test_keyframes_are_kept_bit_by_bit_and_need_no_video(tmp_path: Path, pix_fmt: str, rotation: int) -> None:
    video = write_video(tmp_path / "a.mp4", noisy_frames(64, 48), pix_fmt=pix_fmt, rotation=rotation)
    camera = opened(video)
    kept = with_kept(camera, tmp_path)
    assert kept.kept is not None
    assert kept.kept.frames.tolist() == CHOSEN
    wanted = both(camera, CHOSEN)
    video.unlink()
    assert_same(both(kept, CHOSEN), wanted)


@pytest.mark.parametrize("reported", [0, 1, 2], ids=["range not reported", "studio range", "full range"])
@pytest.mark.parametrize(
    ("pix_fmt", "off"),
    [
        *((name, 0) for name in ("gray", "gray10le", "gray16le", "nv12", "yuv444p", "yuvj422p", "yuvj444p")),
        *((name, 1) for name in ("yuv420p10le", "yuv422p10le", "rgb24", "bgr0", "gbrp")),
    ],
)
def test_luma_of_any_format_is_kept_in_the_range_that_is_reported(
    pix_fmt: str, off: int, reported: int
) -> None:
    ramp = np.tile(np.arange(256, dtype=np.uint8), (16, 1))
    frame = av.VideoFrame.from_ndarray(np.stack([ramp, ramp[::-1], 255 - ramp], axis=-1), format="rgb24")
    frame = frame.reformat(format=pix_fmt)
    frame.color_range = reported
    upright = ((1, 0), (0, 1))
    grey = work_image(frame, upright, (256, 16), colour=False)
    kept = grey_from_planes(work_planes(frame, upright, (256, 16)), (256, 16))
    assert np.ptp(grey) > 100
    assert np.abs(kept.astype(int) - grey).max() <= off


@pytest.mark.parametrize("pix_fmt", ["gray", "gray10le"])
def test_a_grey_video_is_kept_in_its_own_shades(tmp_path: Path, pix_fmt: str) -> None:
    frames = [frame[..., 0] for frame in noisy_frames(64, 48)]
    camera = opened(write_video(tmp_path / "a.mkv", frames, codec="ffv1", pix_fmt=pix_fmt))
    shades = zip(both(with_kept(camera, tmp_path), CHOSEN), both(camera, CHOSEN), strict=True)
    assert max(np.abs(a.astype(int) - b).max() for (_, a), (_, b) in shades) <= 2 * (pix_fmt != "gray")


def test_one_frame_more_is_read_from_the_video_in_its_place(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", noisy_frames(64, 48)))
    assert_same(both(with_kept(camera, tmp_path), [0, 3, 4, 7, 11]), both(camera, [0, 3, 4, 7, 11]))


@pytest.mark.parametrize("size", [0, 2000])
def test_copies_that_cannot_be_read_are_replaced_by_the_video_and_reported(
    tmp_path: Path, size: int, caplog: pytest.LogCaptureFixture
) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", noisy_frames(64, 48)))
    kept = with_kept(camera, tmp_path)
    copy = tmp_path / "kept.mp4"
    copy.write_bytes(copy.read_bytes()[:size])
    assert_same(both(kept, [0, 3, 4, 7, 11]), both(camera, [0, 3, 4, 7, 11]))
    assert any("stored copy" in message and str(copy) in message for message in caplog.messages)


def test_a_whole_video_is_not_decoded_twice(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", noisy_frames(64, 48)))
    kept = with_kept(camera, tmp_path)
    (tmp_path / "kept.mp4").unlink()
    assert [index for index, _ in kept.grey_frames()] == list(range(12))


@pytest.mark.parametrize("rotation", [0, 90])
def test_large_videos_are_kept_whole_at_the_work_size(tmp_path: Path, rotation: int) -> None:
    video = write_video(tmp_path / "a.mp4", noisy_frames(480, 360, 40), rotation=rotation)
    camera = opened(video, work_px=161)
    assert (camera.camera.width_px % 2, camera.camera.height_px % 2) == (1, 1)
    kept = with_kept(camera, tmp_path)
    wanted = both(camera, list(range(12)))
    video.unlink()
    found = both(kept, list(range(12)))
    assert [index for index, _ in found] == 2 * list(range(12))
    for (_, a), (_, b) in zip(found, wanted, strict=True):
        assert a.shape == b.shape
        # 1.3 levels of crf 12; of halved chroma, all of an edge's two pixels in squares of 13. Another frame
        # is 60 off in grey, 85 in colour.
        assert np.abs(a.astype(int) - b).mean() < (2.6 if a.ndim == 2 else 85 * 4 / 13)


def test_what_is_seen_of_a_large_video_is_what_any_stage_sees(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", noisy_frames(480, 360)), work_px=161)
    seen = [(shot.index, shot.grey) for shot in camera.frame_candidates()]
    assert_same(seen, list(camera.grey_frames()))


def test_the_same_video_is_kept_in_the_same_bytes(tmp_path: Path) -> None:
    for work_px in (960, 161):
        camera = opened(write_video(tmp_path / "a.mp4", noisy_frames(480, 360)), work_px=work_px)
        with_kept(camera, tmp_path)
        first = (tmp_path / "kept.mp4").read_bytes()
        with_kept(camera, tmp_path)
        assert (tmp_path / "kept.mp4").read_bytes() == first


def test_the_stages_after_the_keyframes_find_these_kept(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", noisy_frames(64, 48))
    config = CameraConfig(name="torso", video=(video,), calibration="auto")
    capture = CaptureRef(config=CaptureConfig(cameras=(config,)), digests={})
    task = KeyframesTask(options=KeyframeOptions(), capture=capture)
    run_keyframes(task, StageContext(work_dir=tmp_path), tmp_path)
    camera = load_capture(capture, {"torso": ArtefactRef(path=tmp_path, digest="")}).cameras[0]
    assert camera.kept is not None
    assert camera.kept.frames.tolist() == load_keyframes(tmp_path).frames.tolist()
    assert load_capture(capture).cameras[0].kept is None
