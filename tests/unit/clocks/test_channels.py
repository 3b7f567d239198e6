"""Cameras whose clock only one channel, or only a further sound track, tells."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.clocks import estimate_clocks
from bodycap_batch.clocks.sound_track import read_channels, read_sound_track
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.synthetic.sound import Samples
from tests.sounds import heard, scene, write_video_with_sound

SECONDS = 8.0
PALM_S = 0.731
WAY_S = 0.004
"""The way of sound to two cameras on one body differs by up to 1.3 m."""
Arrange = Callable[[Samples, Samples], list[Samples]]
"""Function that returns the sound tracks (channels,N) of a camera, from its own sound and that of another
microphone."""
SILENT = np.zeros(round(SECONDS * 16_000), np.float32)
ARRANGEMENTS: dict[str, tuple[Arrange, str]] = {
    "inverted": (lambda own, other: [np.stack([own, -own])], "channel 1 of sound track 1"),
    "second track": (
        lambda own, other: [np.stack([SILENT, SILENT]), np.stack([own, own])],
        "channel 1 of sound track 2",
    ),
    "loud other": (lambda own, other: [np.stack([20 * other, 0.03 * own])], "channel 2 of sound track 1"),
    "other first": (
        lambda own, other: [np.stack([other, other]), np.stack([SILENT, own])],
        "channel 2 of sound track 2",
    ),
}


@pytest.fixture(scope="module")
def sounds() -> dict[str, Samples]:
    """What two cameras hear of one scene, and what two other microphones hear of other scenes."""
    room = scene(21, SECONDS)
    return {
        "torso": heard(room, 1, SECONDS),
        "left_palm": heard(room, 2, SECONDS, PALM_S),
        "other": 0.02 * heard(scene(22, SECONDS), 3, SECONDS),
        "another": heard(scene(23, SECONDS), 4, SECONDS),
    }


def _write(folder: Path, name: str, tracks: list[Samples]) -> CameraConfig:
    path = write_video_with_sound(folder / f"{name}.mp4", tracks[0], layout="stereo", more=tracks[1:])
    return CameraConfig(name=name, video=(path,))


def _kept(camera: CameraConfig) -> list[str]:
    videos = tuple(map(index_video, camera.video))
    times_ns = videos[0].times_ns()
    mix = read_sound_track(camera.name, videos, times_ns)
    return [track.name for track in read_channels(mix, videos, times_ns)]


@pytest.mark.parametrize(
    ("camera", "kind"), [("torso", "inverted"), *(("left_palm", kind) for kind in ARRANGEMENTS)]
)
def test_any_channel_gives_the_clock(
    tmp_path: Path, sounds: dict[str, Samples], kind: str, camera: str
) -> None:
    arrange, channel = ARRANGEMENTS[kind]
    cameras = [
        _write(
            tmp_path,
            name,
            arrange(sounds[name], sounds["other"]) if name == camera else [np.stack([sounds[name]] * 2)],
        )
        for name in ("torso", "left_palm")
    ]
    found = estimate_clocks(CaptureConfig(cameras=tuple(cameras)))
    clock = found.camera("left_palm")
    assert clock.source == "sound", clock.reasons
    assert clock.offset_s == pytest.approx(PALM_S, abs=WAY_S)
    (pair,) = found.pairs
    assert channel in pair.channels
    assert any(f"the clock comes from {channel}" in reason for reason in found.camera(camera).reasons)


def test_silent_channels_and_copies_are_not_compared(tmp_path: Path, sounds: dict[str, Samples]) -> None:
    own, other = sounds["torso"], sounds["another"]
    assert _kept(_write(tmp_path, "copies", [np.stack([own, 0.1 * own]), np.stack([own, -own])])) == [""]
    assert _kept(_write(tmp_path, "one", [np.stack([SILENT, own])])) == [""]
    times_s = np.arange(len(own)) / 16_000
    hum = np.sum([np.sin(2 * np.pi * 50 * k * times_s + k * k) / k for k in range(1, 60)], axis=0)
    hum = (0.02 * hum + 1e-4 * np.random.default_rng(0).standard_normal(len(own))).astype(np.float32)
    assert _kept(_write(tmp_path, "hum", [np.stack([hum, own])])) == [""]
    assert _kept(_write(tmp_path, "only hum", [np.stack([hum, hum])])) == []
    stereo = _kept(_write(tmp_path, "two", [np.stack([own, other]), np.stack([other, SILENT])]))
    assert stereo == ["", "channel 1 of sound track 1", "channel 2 of sound track 1"]


def test_the_channels_of_chapters_share_one_clock(tmp_path: Path, sounds: dict[str, Samples]) -> None:
    halves = np.split(sounds["left_palm"], [len(SILENT) // 2])
    chapters = [_write(tmp_path, f"{k}", [np.stack([half, -half])]).video[0] for k, half in enumerate(halves)]
    palm = CameraConfig(name="left_palm", video=tuple(chapters))
    torso = _write(tmp_path, "torso", [np.stack([sounds["torso"]] * 2)])
    clock = estimate_clocks(CaptureConfig(cameras=(torso, palm))).camera("left_palm")
    assert clock.offset_s == pytest.approx(PALM_S, abs=WAY_S)


def test_silence_in_all_channels_has_a_reason(tmp_path: Path, sounds: dict[str, Samples]) -> None:
    silent = _write(tmp_path, "left_palm", [np.stack([SILENT, SILENT]), np.stack([SILENT, SILENT])])
    torso = _write(tmp_path, "torso", [np.stack([sounds["torso"]] * 2)])
    clock = estimate_clocks(CaptureConfig(cameras=(torso, silent))).camera("left_palm")
    assert (clock.source, clock.reasons) == ("none", ("the sound is silent",))


def test_channels_of_unrelated_recordings_are_refused(tmp_path: Path, sounds: dict[str, Samples]) -> None:
    torso = _write(tmp_path, "torso", [np.stack([sounds["torso"], 5 * sounds["other"]])])
    palm = _write(tmp_path, "left_palm", [np.stack([sounds["another"], 0.01 * sounds["another"][::-1]])])
    clock = estimate_clocks(CaptureConfig(cameras=(torso, palm))).camera("left_palm")
    assert clock.source == "none"
    assert clock.reasons[0].startswith("with torso: ")


def test_channels_are_not_read_where_the_mix_is_enough(
    tmp_path: Path, sounds: dict[str, Samples], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("bodycap_batch.clocks.sound_evidence.read_channels", refuse)
    cameras = [_write(tmp_path, name, [np.stack([sounds[name]] * 2)]) for name in ("torso", "left_palm")]
    assert estimate_clocks(CaptureConfig(cameras=tuple(cameras))).camera("left_palm").source == "sound"
