"""Everything that states a time: files of timestamps, packet order, starts, rates, copied pictures."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera, open_camera
from bodycap_batch.capture.damage import find_damage_and_copies
from bodycap_batch.capture.frame_index import index_videos
from bodycap_batch.capture.kept import FrameKeeper
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.clocks.sound_track import read_sound_track
from bodycap_batch.config import KeyframeOptions
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.frame_table import COLUMNS
from bodycap_batch.job_places import capture_of_results
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.model.copied_frames import copied_notes
from bodycap_batch.model.scene import KeyframeSelection
from tests.videos import Image, textured_frame, write_video

COUNT = 40
FRAMES = [textured_frame(index) for index in range(COUNT)]
EVEN_NS = np.arange(COUNT) * 1e9 / 30
KEEP_PTS = {"avoid_negative_ts": "disabled"}


def opened(*videos: Path, camera: dict[str, object] | None = None, **capture: object) -> CaptureCamera:
    config = CameraConfig(name="torso", video=videos, calibration="auto", **(camera or {}))
    return open_camera(CaptureConfig(cameras=(config,), **capture), config, 1)


def shown(camera: CaptureCamera) -> list[int]:
    """Return the index that each frame was drawn with."""
    return [round((float(np.median(image[28:, 36:])) - 40.0) / 4.0) for _, image in camera.grey_frames()]


def remuxed(source: Path, target: Path, shift: int = 0, **options: str) -> Path:
    """Copy packets into another container, moved by `shift` units of the source's time base."""
    with av.open(str(source)) as old, av.open(str(target), "w", options=options) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.dts is not None:
                packet.pts, packet.dts = (packet.pts or 0) + shift, packet.dts + shift
                packet.stream = stream
                new.mux(packet)
    return target


# Files of timestamps


def stamped(folder: Path, lines: Sequence[object]) -> CaptureCamera:
    path = write_video(folder / "a.mp4", FRAMES)
    sidecar = folder / "a.timestamps.txt"
    sidecar.write_text("\n".join(map(str, lines)), encoding="utf-8-sig")
    return opened(path, camera={"timestamps": (sidecar,)})


@pytest.mark.parametrize("start_s", [0, 1_700_000_000])
@pytest.mark.parametrize(
    ("per_second", "digits", "name"),
    [
        (1, 6, ""),
        (10**3, 3, "milliseconds"),
        (10**3, 0, "milliseconds"),
        (10**6, 0, "microseconds"),
        (10**7, 0, "units of 100 ns"),
        (10**9, 0, "nanoseconds"),
    ],
)
def test_the_unit_of_timestamps_is_found(
    tmp_path: Path, start_s: int, per_second: int, digits: int, name: str
) -> None:
    times_ns = [start_s * 10**9 + round(index * 1e9 / 30) + 3_000_000 * (index % 3) for index in range(COUNT)]
    camera = stamped(tmp_path, [f"{Decimal(t) * per_second / 10**9:.{digits}f}" for t in times_ns])
    assert np.abs(camera.times_ns - np.array(times_ns)).max() <= 0.5e9 / per_second / 10**digits
    assert [f"are read as {name}" in note for note in camera.notes] == [True] * bool(name)


def test_frame_numbers_are_multiples_of_the_frame_interval(tmp_path: Path) -> None:
    numbers = [*range(1, 20), *range(24, 24 + COUNT - 19)]  # the camera dropped four frames
    camera = stamped(tmp_path, numbers)
    assert np.abs(camera.times_ns - np.array(numbers) * 1e9 / 30).max() < 1e5
    assert "read as frame numbers" in camera.notes[0]


@pytest.mark.parametrize("speed", [8.0, 0.25])
def test_slow_motion_is_no_unit(tmp_path: Path, speed: float) -> None:
    camera = stamped(tmp_path, [index / 30 / speed for index in range(COUNT)])
    assert np.abs(camera.times_ns - EVEN_NS / speed).max() <= 1
    assert "played at another speed" in camera.notes[0]
    assert camera.nominal_fps == pytest.approx(30 * speed, rel=1e-3)


@pytest.mark.parametrize("per_second", [90_000, 60.0, 1 / 60])
def test_timestamps_that_contradict_the_video_are_refused_with_the_numbers(
    tmp_path: Path, per_second: float
) -> None:
    with pytest.raises(CaptureError, match=r"40 times in a.timestamps.txt span .*lasts 1\.30 s") as caught:
        stamped(tmp_path, [round(index * per_second / 30, 6) for index in range(COUNT)])
    assert caught.value.hint


def test_gaps_between_chapters_do_not_change_the_unit(tmp_path: Path) -> None:
    videos = [write_video(tmp_path / f"a{k}.mp4", FRAMES[:20]) for k in (1, 2)]
    sidecar = tmp_path / "a.timestamps.txt"
    times_ms = [round(index * 1000 / 30 + 60_000 * (index >= 20)) for index in range(COUNT)]
    sidecar.write_text("\n".join(map(str, times_ms)))
    camera = opened(*videos, camera={"timestamps": (sidecar,)})
    assert camera.times_ns.tolist() == [time * 10**6 for time in times_ms]


# Recordings that were joined byte by byte


@pytest.mark.parametrize(
    ("suffix", "codec", "options"),
    [
        ("ts", "libx264", {}),
        ("m2ts", "libx264", {}),
        ("mkv", "libx264", {}),
        ("mkv", "libx264", {"live": "1"}),
        ("webm", "libvpx", {}),
        ("mpg", "mpeg2video", {}),
        ("flv", "libx264", {}),
        ("wmv", "wmv2", {}),
        ("avi", "mpeg4", {}),
        ("mov", "libx264", {}),
        ("mp4", "libx264", {}),
        ("mp4", "libx264", {"movflags": "faststart"}),
        ("mp4", "libx264", {"movflags": "frag_keyframe+empty_moov"}),
    ],
)
def test_no_frame_of_joined_recordings_vanishes(
    tmp_path: Path, suffix: str, codec: str, options: dict[str, str]
) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    parts = []
    for number, frames in enumerate((FRAMES[:25], FRAMES[25:])):
        name = f"{number}.mp4" if options else f"{number}.{suffix}"
        source = write_video(tmp_path / name, frames, codec=codec, ticks=1)
        part = remuxed(source, tmp_path / f"part{number}.{suffix}", **options) if options else source
        parts.append(part.read_bytes())
    path = tmp_path / f"joined.{suffix}"
    path.write_bytes(b"".join(parts))
    camera = opened(path)
    assert len(camera.frame_numbers) == COUNT
    assert np.abs(np.diff(camera.times_ns) - 1e9 / 30).max() <= 1.1e6  # Matroska and FLV keep milliseconds
    if codec == "libx264":  # the others blur levels
        assert shown(camera) == list(range(COUNT))
    stream = dict(camera.grey_frames())
    assert all(np.array_equal(image, stream[k]) for k, image in camera.read([3, 24, 25, 39]))
    if suffix != "avi":  # its frames have no times, but an order
        assert "start again at frame 25, as in a file of 2 recordings" in camera.notes[0]


def test_a_second_recording_that_starts_in_the_middle_of_a_group(tmp_path: Path) -> None:
    first = write_video(tmp_path / "a.ts", [*FRAMES, *FRAMES[:20]], gop=12, bframes=False).read_bytes()
    second = write_video(tmp_path / "b.ts", FRAMES, gop=12, bframes=False).read_bytes()
    cut = len(second) // 188 // 8 * 188
    path = tmp_path / "joined.ts"
    path.write_bytes(first + second[: 188 * 3] + second[cut:])  # with the tables at its start
    camera = opened(path)
    assert (np.diff(camera.times_ns) > 0).all()
    decoded = [shot.index for shot in camera.frame_candidates()]
    assert set(range(60)) <= set(decoded)
    assert len(decoded) >= 60 + COUNT - 12


def test_times_of_33_bits_overflow(tmp_path: Path) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, ticks=1)
    with av.open(str(source)) as container:
        base = Fraction(container.streams.video[0].time_base or 1)
    camera = opened(remuxed(source, tmp_path / "a.ts", shift=int((2**33 / 90_000 - 2.0) / base)))
    assert np.abs(camera.times_ns - EVEN_NS).max() <= 1e4
    assert shown(camera) == list(range(COUNT))
    assert camera.notes == ()


def write_with_sound(path: Path, seconds: float, metadata: dict[str, str] | None = None) -> Path:
    """Write `FRAMES` with a sound whose loudness changes once a second."""
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata.update(metadata or {})
        video = container.add_stream("libx264", rate=30, options={"preset": "ultrafast"})
        video.height, video.width = FRAMES[0].shape
        video.pix_fmt = "yuv420p"
        audio = container.add_stream("aac", rate=16_000)
        for index, image in enumerate(FRAMES):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts = index
            container.mux(video.encode(frame))
        wave = np.random.default_rng(0).normal(0.0, 0.1, round(16_000 * seconds)).astype(np.float32)
        for start in range(0, len(wave), 1024):
            sound = av.AudioFrame.from_ndarray(wave[None, start : start + 1024], format="fltp", layout="mono")
            sound.sample_rate, sound.pts = 16_000, start
            container.mux(audio.encode(sound))
        for stream in (video, audio):
            container.mux(stream.encode())
    return path


def test_sound_of_the_second_recording_follows_its_pictures(tmp_path: Path) -> None:
    part = write_with_sound(tmp_path / "a.ts", COUNT / 30)
    joined = tmp_path / "joined.ts"
    joined.write_bytes(2 * part.read_bytes())
    videos, alone = index_videos([joined]), index_videos([part])
    track = read_sound_track("torso", videos, join_chapters(videos, ()).times_ns)
    single = read_sound_track("torso", alone, join_chapters(alone, ()).times_ns)
    assert len(track.pieces) == 2
    # The second part begins one frame after the last frame of the first.
    assert track.end_s - COUNT / 30 == pytest.approx(single.end_s, abs=1e-3)


# The start of a file


@pytest.mark.parametrize(
    ("suffix", "options"),
    [("ts", {}), ("m2ts", {}), ("flv", {}), ("mp4", {"use_editlist": "0"}), ("mkv", {})],
)
def test_the_first_frame_is_the_start_of_a_file_that_states_no_other(
    tmp_path: Path, suffix: str, options: dict[str, str]
) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, ticks=1)
    with av.open(str(source)) as container:
        reordered = container.streams.video[0].codec_context.has_b_frames
    path = remuxed(source, tmp_path / f"b.{suffix}", **options)
    assert reordered
    camera = opened(path, clocks="common")
    assert camera.times_ns[0] == 0
    assert camera.notes == ()


def test_a_program_stream_starts_with_its_first_frame(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mpg", FRAMES, codec="mpeg2video", ticks=1))
    assert np.abs(camera.times_ns - EVEN_NS).max() <= 1e4


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_a_start_that_the_file_states_is_kept_and_named(tmp_path: Path, suffix: str) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, ticks=1)
    with av.open(str(source)) as container:
        base = Fraction(container.streams.video[0].time_base or 1)
    path = remuxed(source, tmp_path / f"late.{suffix}", shift=int(Fraction(1, 2) / base))
    camera = opened(path, clocks="common")
    assert camera.times_ns[0] == pytest.approx(0.5e9, abs=1e6)
    assert "0.500 s after the start of the file" in camera.notes[0]
    assert opened(path).notes == ()


# The rate at which the pictures were taken


@pytest.mark.parametrize(
    ("key", "rate", "fps", "ratio"),
    [
        ("com.android.capture.fps", "120.000000", 30, 4.0),
        ("com.android.capture.fps", "240.000000", 30, 8.0),
        ("com.android.capture.fps", "60", 30, 2.0),
        ("com.android.capture.fps", "120.000000", 15, 4.0),  # the sensor delivered every second picture
        ("com.android.capture.fps", "30.000000", 30, 1.0),
        ("com.android.capture.fps", "30.000000", 15, 1.0),  # a dim room
        ("com.android.capture.fps", "240.000000", 240, 1.0),
        ("com.android.capture.fps", "5.000000", 30, 1 / 6),  # a time lapse
        ("com.maker.SensorFrameRate", "96", 24, 4.0),
        ("creation.note", "120", 30, 1.0),
    ],
)
def test_slow_motion_gets_the_times_at_which_it_was_filmed(
    tmp_path: Path, key: str, rate: str, fps: int, ratio: float
) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, fps=fps)
    path = tmp_path / "tagged.mp4"
    options = {"movflags": "use_metadata_tags"}
    with av.open(str(source)) as old, av.open(str(path), "w", options=options) as new:
        new.metadata[key] = rate
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    camera = opened(path)
    assert np.abs(camera.times_ns - np.arange(COUNT) * 1e9 / fps / ratio).max() <= max(1.0, 1.0 / ratio)
    assert camera.nominal_fps == pytest.approx(fps * ratio, rel=1e-3)
    assert len(camera.notes) == (ratio != 1.0)
    assert all(("slow motion" if ratio > 1 else "time lapse") in note for note in camera.notes)


def test_the_rates_in_the_text_of_a_camera_are_read(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES)
    text = b'<VideoFrame videoCodec="AVC" captureFps="119.88p" formatFps="29.97p"/>'
    path.write_bytes(path.read_bytes() + (8 + len(text)).to_bytes(4, "big") + b"meta" + text)
    assert opened(path).times_ns[-1] == pytest.approx(EVEN_NS[-1] * 30 / 119.88, abs=2)


@pytest.mark.parametrize(
    ("rate", "sound_s", "ratio", "note"),
    [
        (60, COUNT / 30, 1.0, "Because it has sound"),
        (120, COUNT / 30, 4.0, "slow motion"),
        (120, COUNT / 120, 4.0, "slow motion"),
        (30, COUNT / 30, 1.0, ""),
        (30, 4.0, 1.0, "the pictures last 1.33 s, and the sound 4"),
    ],
)
def test_the_sound_is_compared_with_the_rates(
    tmp_path: Path, rate: int, sound_s: float, ratio: float, note: str
) -> None:
    path = write_with_sound(tmp_path / "a.mp4", sound_s, {"com.android.capture.fps": str(rate)})
    camera = opened(path)
    assert camera.times_ns[-1] == pytest.approx(EVEN_NS[-1] / ratio, abs=2)
    assert [note in each for each in camera.notes] == [True] * bool(note)
    track = read_sound_track("torso", camera.videos, camera.times_ns)
    assert bool(track.problem) == (ratio != 1.0)


# Pictures that are copies of the one before


def moving_picture(travel_px: float) -> Image:
    """Return a picture of a wall with texture, of a camera that has moved along it."""
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 255, (40, 200)).astype(np.uint8)
    wall = np.kron(coarse, np.ones((4, 4), np.uint8))
    start = round(travel_px)
    noise = np.random.default_rng(start).normal(0.0, 1.0, (120, 160))
    return np.clip(wall[20:140, start : start + 160] + noise, 0, 255).astype(np.uint8)


def selected(path: Path, tmp_path: Path) -> tuple[CaptureCamera, KeyframeSelection]:
    camera = opened(path)
    return camera, select_keyframes(camera, KeyframeOptions(), StageContext(work_dir=tmp_path, threads=1))


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("rates", [(24, 30), (24, 60), (25, 30), (30, 50), (15, 30)])
def test_pictures_of_a_converted_video_get_the_times_of_their_source(
    tmp_path: Path, rates: tuple[int, int], codec: str
) -> None:
    source, target = rates
    taken = [index * source // target for index in range(3 * target)]
    frames = [moving_picture(120 / source * picture) for picture in taken]
    camera, selection = selected(write_video(tmp_path / "a.mp4", frames, fps=target, codec=codec), tmp_path)
    copies = [index for index, (one, two) in enumerate(pairwise(taken), start=1) if one == two]
    assert selection.pictures is not None
    found = np.setdiff1d(np.arange(len(frames)), selection.pictures.frames)
    assert np.setxor1d(found, copies).tolist() in ([], [len(frames) - 1])
    used = camera.only(selection.pictures)
    expected_ns = np.array(taken)[used.frame_numbers] * 1e9 / source
    error_ns = used.times_ns - expected_ns
    # The conversion shows each picture at the next frame, and nothing tells how much later that is.
    assert -0.05e9 / target < error_ns.min() <= error_ns.max() < 1.05e9 / target
    assert np.ptp(error_ns) < 0.06e9 / target
    assert used.nominal_fps == pytest.approx(source, rel=0.01)
    (note,) = copied_notes(camera.times_ns, selection.pictures)
    assert f"{len(found)} of {len(frames)} frames are copies" in note
    # `check` tracks no points, and misses some copies that the encoder encoded again.
    _, pictures = find_damage_and_copies(camera)
    assert pictures is not None
    assert np.setxor1d(pictures.frames, selection.pictures.frames).size <= 0.06 * len(frames)


@pytest.mark.parametrize("regular", [True, False])
def test_copies_that_replace_pictures_do_not_move_the_others(tmp_path: Path, regular: bool) -> None:
    rng = np.random.default_rng(1)
    missed = range(2, 90, 5) if regular else np.flatnonzero(rng.uniform(size=89) < 0.15) + 1
    taken = list(range(90))
    for index in missed:
        taken[index] = taken[index - 1]
    frames = [moving_picture(4 * picture) for picture in taken]
    camera, selection = selected(write_video(tmp_path / "a.mp4", frames), tmp_path)
    assert selection.pictures is not None
    assert np.setxor1d(selection.pictures.frames, np.unique(taken)).size <= 1
    assert (selection.pictures.times_ns == camera.times_ns[selection.pictures.frames]).all()
    assert selection.frame_count == len(selection.sharpness) == len(selection.pictures.frames)
    assert selection.matches is not None
    assert selection.matches.frame.max() < selection.frame_count - 1
    _, without = selected(
        write_video(tmp_path / "b.mp4", [moving_picture(4 * k) for k in range(90)]), tmp_path
    )
    assert 0.5 < selection.noise_px / without.noise_px < 2.0


def test_a_camera_that_stands_still_has_no_copies(tmp_path: Path) -> None:
    travel = [4 * min(index, 20) + 4 * max(index - 60, 0) for index in range(90)]
    for name, frames in (
        ("stops", [moving_picture(each) for each in travel]),
        ("still", [moving_picture(0.0)] * 90),
    ):
        path = write_video(tmp_path / f"{name}.mp4", frames, gop=4)
        _, selection = selected(path, tmp_path)
        assert selection.pictures is None, name


def test_the_served_videos_have_the_frames_of_the_results(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    write_video(folder / "torso.mp4", FRAMES)
    lines = [
        f"torso,{number},{number / 24:.9f},{number / 24:.9f},LOST,BLUR,0,,," for number in range(0, COUNT, 2)
    ]
    (tmp_path / "frames.csv").write_text("\n".join([",".join(COLUMNS), *lines]))
    job = load_job(folder)
    (camera,) = capture_of_results(job, tmp_path).cameras
    assert camera.frame_numbers.tolist() == list(range(0, COUNT, 2))
    assert np.abs(camera.times_ns - np.arange(0, COUNT, 2) * 1e9 / 24).max() <= 1
    (camera,) = capture_of_results(job, folder).cameras
    assert len(camera.frame_numbers) == COUNT


def test_stored_copies_of_frames_keep_their_pictures(tmp_path: Path) -> None:
    taken = [round(index * 0.8) for index in range(60)]
    path = write_video(tmp_path / "a.mp4", [moving_picture(5 * picture) for picture in taken])
    camera = opened(path, work_px=160)
    size = camera.camera
    for keep_all in (True, False):
        with FrameKeeper(tmp_path, size.width_px, size.height_px, keep_all) as keeper:
            selection = select_keyframes(
                camera, KeyframeOptions(), StageContext(work_dir=tmp_path, threads=1), keeper
            )
        used, kept = camera.only(selection.pictures), keeper.kept_frames()
        assert kept is not None
        kept = kept.only(selection.pictures)
        wanted = selection.frames
        assert kept.holds(wanted).all()
        stored = list(kept.read(wanted, (size.width_px, size.height_px), colour=False, threads=1))
        for (_, image), copy in zip(used.read(wanted), stored, strict=True):
            assert np.abs(image.astype(int) - copy).mean() < 3.0
