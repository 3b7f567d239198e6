"""Videos with sound for tests."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from scipy.signal import butter, sosfilt

from bodycap_batch.clocks.sound_track import RATE_HZ, SoundPiece, SoundTrack
from bodycap_batch.formats.file_url import file_url
from bodycap_batch.formats.mp4_writer import sound_frames
from bodycap_batch.synthetic.sound import Microphone, Samples, Scene, make_scene, record
from tests.videos import textured_frame

FPS = 10


def write_video_with_sound(
    path: Path,
    samples: Samples | None,
    rate_hz: int = 16_000,
    *,
    layout: str = "mono",
    sound_start_s: float = 0.0,
    gap: tuple[float, float] | None = None,
    seconds: float | None = None,
    frame_times: Sequence[int] | None = None,
    metadata: dict[str, str] | None = None,
    more: Sequence[Samples] = (),
) -> Path:
    """Write tiny pictures at 10 fps with sound.

    Args:
        samples: (N,) or (channels,N); None for a video without sound.
        gap: Time in the sound, and duration, of a jump of the timestamps, seconds.
        seconds: Duration of the pictures; default: that of the sound.
        frame_times: Times of the frames in thousandths of a second, for a variable frame rate.
        more: (2,N) samples of further sound tracks.
    """
    length = 1.0 if samples is None else np.atleast_2d(samples).shape[1] / rate_hz
    with av.open(str(path), "w") as container:
        container.metadata.update(metadata or {})
        pictures = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "g": "10"})
        pictures.width, pictures.height, pictures.pix_fmt = 64, 48, "yuv420p"
        pictures.time_base = pictures.codec_context.time_base = Fraction(1, 1000)
        sound = None if samples is None else container.add_stream("aac", rate=rate_hz, layout=layout)
        others = [container.add_stream("aac", rate=rate_hz, layout="stereo") for _ in more]
        count = int((seconds or length) * FPS)
        for number, time_ms in enumerate(frame_times or range(0, 100 * count, 100)):
            frame = av.VideoFrame.from_ndarray(textured_frame(number % 40), format="gray")
            frame.pts, frame.time_base = time_ms, Fraction(1, 1000)
            container.mux(pictures.encode(frame))
        container.mux(pictures.encode())
        if sound is not None:
            for frame in sound_frames(samples, rate_hz, layout, round(sound_start_s * rate_hz)):
                if gap is not None and frame.pts >= gap[0] * rate_hz:
                    frame.pts += round(gap[1] * rate_hz)
                container.mux(sound.encode(frame))
            container.mux(sound.encode(None))
        for other, track_samples in zip(others, more, strict=True):
            for frame in sound_frames(track_samples, rate_hz, "stereo"):
                container.mux(other.encode(frame))
            container.mux(other.encode(None))
    return path


def burst(seconds: float, at_s: float, rate_hz: int = RATE_HZ, seed: int = 0) -> Samples:
    """Return silence with 10 ms of noise that starts at a time."""
    out = np.zeros(round(seconds * rate_hz), np.float32)
    first = round(at_s * rate_hz)
    out[first : first + rate_hz // 100] = 0.3 * np.random.default_rng(seed).standard_normal(rate_hz // 100)
    return out


def burst_time(track: SoundTrack) -> float:
    """Return when a burst starts on the camera's clock: where the sound first exceeds a tenth of its peak."""
    start = track.start_s - 0.1
    samples = np.abs(track.samples(start, round((track.end_s - start) * RATE_HZ)))
    return start + float(np.argmax(samples > 0.2 * samples.max())) / RATE_HZ


def track(samples: Samples, camera: str = "a", start_s: float = 0.0) -> SoundTrack:
    """Return samples at 16 kHz as the sound of a camera."""
    return SoundTrack(camera=camera, pieces=(SoundPiece(start_s, (samples * 32767).astype(np.int16)),))


def scene(
    seed: int, seconds: float, sources: tuple[str, ...] = ("voice", "steps", "claps", "distant")
) -> Scene:
    """Return a scene from 2 s before time 0 to 3 s after the given duration."""
    return make_scene(-2.0, seconds + 3.0, seed=seed, rate_hz=RATE_HZ, sources=sources)


def heard(of: Scene, seed: int, seconds: float, offset_s: float = 0.0, **more: float) -> Samples:
    """Return what a microphone records of a scene, with cloth noise 6 dB below it unless given."""
    options = {"noise_ratio_db": 6.0, "gain_db": -6.0, **more}
    return record(of, Microphone(seed=seed, seconds=seconds, offset_s=offset_s, **options))  # type: ignore[arg-type]


def wind_noise(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return the noise (N,) of wind: strong, below some 200 Hz, with gusts."""
    band = butter(2, (5.0, 150.0), "bandpass", fs=rate_hz, output="sos").astype(np.float32)
    low = sosfilt(band, rng.standard_normal(count, np.float32))
    knots = max(2, int(count / rate_hz))
    gusts = np.interp(np.arange(count), np.linspace(0, count, knots + 1), rng.uniform(0.2, 1.0, knots + 1))
    return (low * gusts).astype(np.float32)


def write_sound(
    path: Path, samples: np.ndarray, rate_hz: int, *, codec: str = "aac", layout: str = "mono"
) -> Path:
    """Encode sound into a media file without pictures.

    Args:
        path: Path of the file; its suffix determines the container.
        samples: (N,) or (channels,N) samples.
        rate_hz: Samples per second.
        codec: Name of the encoder.
        layout: Channels, for example ``mono``, ``stereo`` or ``5.1``.
    """
    with av.open(file_url(path), "w") as container:
        stream = container.add_stream(codec, rate=rate_hz, layout=layout)
        for frame in sound_frames(samples, rate_hz, layout):
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
