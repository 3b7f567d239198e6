"""Captures with truth, altered as in practice: codecs, rates, light, covered lenses."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.tum import TimedPoses, read_tum, write_tum
from tests.videos import Image

_TICKS = 90_000
_SOUND_HZ = 16_000


@dataclass(frozen=True, kw_only=True)
class Recording:
    """How one camera's video is recorded.

    Attributes:
        kept: Returns which frames (N,) are kept, given their times (s) and a random generator.
        look: Returns the frame (H,W,3) at a time (s) as it is recorded.
        turn: Quarter turns counter-clockwise by which the picture is stored; a player turns it back.
        sound: With a sound track.
        codec: FFmpeg's name of the encoder.
        options: Options of the encoder.
    """

    kept: Callable[[FloatArray, np.random.Generator], Any] = lambda times_s, rng: times_s >= 0.0
    look: Callable[[Image, float], Image] = lambda image, time_s: image
    turn: int = 0
    sound: bool = False
    codec: str = "libx264"
    options: Mapping[str, str] = field(default_factory=lambda: {"crf": "16", "preset": "superfast"})


def exposed(image: Image, gain: float) -> Image:
    """Return the picture with more or less light."""
    return cv2.convertScaleAbs(image, alpha=gain).astype(np.uint8)


def phone(image: Image, time_s: float) -> Image:
    """Return the picture with an exposure that varies by a factor of three and saturates at its maximum."""
    return exposed(image, 1.0 + 0.5 * float(np.sin(2.0 * np.pi * time_s / 1.7)))


AS_A_PHONE = Recording(
    kept=lambda times_s, rng: rng.uniform(size=len(times_s)) > 0.15,
    look=phone,
    turn=1,
    sound=True,
    codec="libx265",
    options={"crf": "32", "preset": "ultrafast", "x265-params": "log-level=none"},
)
"""Upright in the hand, one frame in seven lost, strongly compressed, with sound."""


def covered(*spans_s: tuple[float, float]) -> Recording:
    """Return a recording in which the lens is covered during the given intervals."""

    def look(image: Image, time_s: float) -> Image:
        if not any(start <= time_s < end for start, end in spans_s):
            return image
        rng = np.random.default_rng(round(1000 * time_s))
        return np.clip(rng.normal(6.0, 2.0, image.shape), 0, 255).astype(np.uint8)

    return Recording(look=look)


def frozen(*spans_s: tuple[float, float]) -> Recording:
    """Return a recording that repeats its last picture during the given intervals."""
    shown: list[Image] = []

    def look(image: Image, time_s: float) -> Image:
        if not shown or not any(start <= time_s < end for start, end in spans_s):
            shown[:] = [image]
        return shown[0]

    return Recording(look=look)


def on_a_tripod(sigma: float) -> Recording:
    """Return a recording of the first picture with sensor noise: the camera stands still.

    Args:
        sigma: Standard deviation of the noise, grey levels.
    """
    shown: list[Image] = []

    def look(image: Image, time_s: float) -> Image:
        shown[:] = shown or [image]
        rng = np.random.default_rng(round(1000 * time_s))
        return np.clip(shown[0] + rng.normal(0.0, sigma, image.shape), 0, 255).astype(np.uint8)

    return Recording(look=look)


def zoomed(fraction: float) -> Recording:
    """Return a recording of the enlarged middle of the picture: a digital zoom that the calibration does not
    know.

    Args:
        fraction: Side of the middle over the side of the picture.
    """

    def look(image: Image, time_s: float) -> Image:
        height, width = image.shape[:2]
        top, left = (round(side * (1.0 - fraction) / 2.0) for side in (height, width))
        middle = image[top : height - top, left : width - left]
        return cv2.resize(middle, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)

    return Recording(look=look)


def slower(every: int, size: tuple[int, int]) -> Recording:
    """Return a recording of every n-th frame in another size."""
    return Recording(
        kept=lambda times_s, rng: np.arange(len(times_s)) % every == 0,
        look=lambda image, time_s: cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8),
    )


def alter(source: Path, target: Path, recordings: Mapping[str, Recording]) -> Path:
    """Record a capture again. Its truth keeps the remaining frames; times do not change.

    Args:
        source: ``<camera>.mp4``, ``calib.json`` and ``gt/``, as `bodycap synth` writes them.
        target: A new folder.
        recordings: Per camera; the other cameras are copied.
    """
    shutil.copytree(source / "gt", target / "gt")
    for path in source.glob("*.json"):
        shutil.copy(path, target)
    for video in sorted(source.glob("*.mp4")):
        if video.stem in recordings:
            _record(video, target, recordings[video.stem])
        else:
            shutil.copy(video, target)
    return target


def _record(video: Path, target: Path, recording: Recording) -> None:
    with av.open(str(video)) as container:
        frames = [
            (float(frame.time), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)
        ]
    times_s = np.array([time_s for time_s, _ in frames])
    kept = np.asarray(recording.kept(times_s, np.random.default_rng(len(video.stem))), dtype=bool)
    kept[[0, -1]] = True
    pictures = [
        (frames[row][0], np.rot90(recording.look(frames[row][1], frames[row][0]), recording.turn))
        for row in np.flatnonzero(kept)
    ]
    _encode(target / video.name, pictures, recording)
    for path in (target / "gt").rglob(f"{video.stem}.tum"):
        truth = read_tum(path)
        write_tum(path, TimedPoses(times_ns=truth.times_ns[kept], world_from_cam=truth.world_from_cam[kept]))


def _encode(path: Path, pictures: list[tuple[float, Image]], recording: Recording) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(recording.codec, rate=30, options=dict(recording.options))
        stream.height, stream.width = pictures[0][1].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, _TICKS)
        if recording.turn:
            stream.set_display_rotation(-90 * recording.turn)
        sound = container.add_stream("aac", rate=_SOUND_HZ) if recording.sound else None
        for time_s, image in pictures:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(time_s * _TICKS), Fraction(1, _TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
        for start in range(0, int(_SOUND_HZ * pictures[-1][0]) if sound else 0, 1024):
            wave = 0.1 * np.sin(np.arange(start, start + 1024) * 0.17)
            tone = av.AudioFrame.from_ndarray(wave[None].astype(np.float32), format="fltp", layout="mono")
            tone.sample_rate, tone.pts = _SOUND_HZ, start
            container.mux(sound.encode(tone))
        if sound:
            container.mux(sound.encode())
