"""Read the sound of a camera: mono, 16 kHz, with the time of its samples on the clock of the camera.

The mono mix of the first sound stream is read first. Its channels may cancel each other, it may be empty, or
it may belong to another microphone. Then each channel of each stream is read as a track of its own.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.timeline import ChapterClock, clock_of_chapter
from bodycap_batch.capture.video import VideoFile, error_reason, open_container
from bodycap_batch.core.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from av.audio.frame import AudioFrame
    from av.audio.stream import AudioStream
    from av.container import InputContainer

RATE_HZ = 16_000
"""Samples per second of every sound track. Origin: the correlation uses frequencies up to 6,000 Hz, and the
filter that reduces the rate needs some room above them."""
_MAX_JUMP_S = 0.01
"""Maximum difference, seconds, of a timestamp from the end of the sound before it. With a larger difference,
sound is missing or repeated, and a new piece starts. Origin: containers with a resolution of 1 ms round
timestamps; the shortest frame of common codecs that can be missing lasts 20 ms."""
_MIN_RESTART_S = 0.2
"""Minimum jump back, seconds, at which the times of a file start again. Evidence: none."""
_MAX_RATE_ERROR = 0.02
"""Maximum relative difference of the clock of the pictures from that of the sound. With a larger one, the
file plays the pictures at another speed. Origin: crystals differ by 0.01 %; nominal rates such as 30 and
29.97 by 0.1 %."""
_HIGH_PASS_HZ = 150.0
"""Frequency, Hz, below which wind and handling are removed. Origin: the correlation uses 200 Hz and above. A
strong sound below leaks into all frequencies where a window cuts it off."""
_FILTER_SAMPLES = RATE_HZ
"""Number of samples that are filtered at once. Origin: limits the memory to some megabytes."""
_FADE_SAMPLES = RATE_HZ // 50
"""Number of samples over which a piece starts and ends: 20 ms. Origin: a sudden start would be a sound that
all recordings have."""
_SILENCE_LSB = 3.0
"""RMS amplitude, in steps of 16 bits, below which a tenth of a second is silent. Origin: the rounding of
samples alone has 0.3 to 1."""
_LEVEL_SAMPLES = RATE_HZ // 10
"""Number of samples from which a level is computed."""
_LEVEL_BLOCKS = 256
"""Number of levels that are computed at once. Origin: limits the memory to some megabytes."""
_BATCH_SAMPLES = 10 * RATE_HZ
"""Number of samples of a piece of a track, if the clock of the frames runs faster or slower than that of the
sound. Within a piece the difference is ignored: 0.5 ms at 50 ppm."""

_MAX_CHANNELS = 6
"""Maximum number of tracks of a camera that are compared, if the mono mix is not enough. Origin: 5.1
sound."""
_LIKE_CORRELATION = 0.95
"""Correlation, without regard to the sign, from which a track is a copy of another one. Derivation: what
differs has less than a tenth of the power."""
_LINE_RATIO = 20.0
"""Power of a frequency relative to those around it from which it belongs to a line of a hum. Evidence:
docs/decisions/clocks.md."""
_LINE_WIDTH_HZ = 41
"""Width, Hz, of the band around a frequency with which it is compared. Origin: less than 50 Hz."""
_MAX_HUM = 0.8
"""Maximum share of the power of a track in such lines. Evidence: docs/decisions/clocks.md."""

_MODEL_KEYS = (
    "com.apple.quicktime.model",
    "com.android.model",
    "model",
    "com.apple.quicktime.make",
    "com.android.manufacturer",
    "make",
)
"""Keys of container metadata that name the model of a camera or its maker."""

Samples = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorder:
    """What a file says about the device and the encoder of its sound.

    Attributes:
        model: Name of the camera model; empty if it is unknown.
        encoder: Container, codec and handlers. Equal cameras write equal values.
        rate_hz: Samples per second of the sound.
    """

    model: str
    encoder: tuple[str, ...]
    rate_hz: int

    def is_like(self, other: Recorder) -> bool:
        """Return True if both files seem to come from cameras of the same model.

        Cameras of different models relate sound and picture differently. If a model is unknown, cameras with
        a difference of encoder or format are treated as different models.
        """
        if self.model and other.model:
            return self.model == other.model
        return (self.model, self.encoder, self.rate_hz) == (other.model, other.encoder, other.rate_hz)


@dataclass(frozen=True, slots=True)
class SoundPiece:
    """Sound without a gap.

    Attributes:
        start_s: Time of the first sample on the clock of the camera, seconds.
        samples: (N,) int16 samples at `RATE_HZ`.
    """

    start_s: float
    samples: npt.NDArray[np.int16]

    @property
    def end_s(self) -> float:
        """Time of the end of the last sample on the clock of the camera, seconds."""
        return self.start_s + len(self.samples) / RATE_HZ


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundTrack:
    """The sound of one camera.

    Attributes:
        camera: Name of the camera.
        name: Name of the channel and its stream for the user; "" for the mono mix of the first stream.
        channels: Number of channels of all streams of the file.
        pieces: Sound without gaps, in the order of time. The gaps between pieces are silent.
        top_hz: Highest frequency that the recording contains, Hz: half its lowest sample rate.
        recorder: What is known about the device and the encoder; None without sound.
        problem: Reason why the sound cannot be used; empty if it can be used.
        notes: Notes for the user about gaps and damage.
    """

    camera: str
    name: str = ""
    channels: int = 1
    pieces: tuple[SoundPiece, ...] = ()
    top_hz: float = RATE_HZ / 2
    recorder: Recorder | None = None
    problem: str = ""
    notes: tuple[str, ...] = ()

    @property
    def start_s(self) -> float:
        """Time of the first sample on the clock of the camera, seconds."""
        return self.pieces[0].start_s

    @property
    def end_s(self) -> float:
        """Time of the end of the sound on the clock of the camera, seconds."""
        return max(piece.end_s for piece in self.pieces)

    def samples(self, start_s: float, count: int) -> Samples:
        """Return samples (count,) from a time on the clock of the camera; 0 where there is no sound.

        The time is rounded to the next sample: `sample_time` gives the exact time of the first one.
        """
        out = np.zeros(count, np.float32)
        for piece in self.pieces:
            first = round((start_s - piece.start_s) * RATE_HZ)
            begin, end = max(first, 0), min(first + count, len(piece.samples))
            if begin < end:
                out[begin - first : end - first] = piece.samples[begin:end]
        return out

    def sample_time(self, time_s: float) -> float:
        """Return the time of the sample that is nearest to a time, on the clock of the camera, seconds."""
        piece = next((piece for piece in self.pieces if time_s < piece.end_s), self.pieces[-1])
        return piece.start_s + round((time_s - piece.start_s) * RATE_HZ) / RATE_HZ

    def levels(self) -> tuple[FloatArray, FloatArray]:
        """Return the start time (N,), in seconds, and the sound level (N,) of successive blocks of 0.1 s.

        The level is the standard deviation of the differences between successive samples.
        """
        times, levels = [], []
        for piece in self.pieces:
            count = len(piece.samples) // _LEVEL_SAMPLES
            blocks = piece.samples[: count * _LEVEL_SAMPLES].reshape(count, _LEVEL_SAMPLES)
            # The mean of a block is no sound; the difference of neighbours suppresses wind and handling.
            for first in range(0, count, _LEVEL_BLOCKS):
                part = blocks[first : first + _LEVEL_BLOCKS].astype(np.float32)
                levels += np.diff(part, axis=1).std(axis=1).tolist()
            times += [piece.start_s + index * _LEVEL_SAMPLES / RATE_HZ for index in range(count)]
        return np.array(times), np.array(levels)


def read_sound_track(camera: str, videos: Sequence[VideoFile], times_ns: IntArray) -> SoundTrack:
    """Read the mono mix of the first sound stream of all chapters of a camera.

    Args:
        camera: Name of the camera.
        videos: The chapters in the order of the recording.
        times_ns: (N,) time of every frame of the chapters on the clock of the camera, nanoseconds: see
            `join_chapters`.

    Returns:
        The sound track. If there is no sound, or no usable sound, `problem` gives the reason.

    Raises:
        CaptureError: A file cannot be opened.
    """
    (mix,) = _read_tracks(camera, videos, times_ns, separate=False)
    return mix


def read_channels(mix: SoundTrack, videos: Sequence[VideoFile], times_ns: IntArray) -> list[SoundTrack]:
    """Return the tracks of a camera that may be compared: the mono mix, and the channels of all streams.

    Silent tracks and those of a hum are left out. So are copies of earlier ones, which may have the sign
    inverted.

    Args:
        mix: The track that `read_sound_track` returned.
        videos: See `read_sound_track`.
        times_ns: See `read_sound_track`.

    Raises:
        CaptureError: A file cannot be opened.
    """
    kept: list[SoundTrack] = []
    for track in (mix, *_read_tracks(mix.camera, videos, times_ns, separate=True)):
        if not (track.problem or _is_hum(track) or any(_is_like(track, other) for other in kept)):
            kept.append(track)
    return kept[:_MAX_CHANNELS]


def _is_hum(track: SoundTrack) -> bool:
    """Return True for the hum of the mains in a channel without a microphone: it resembles any other hum."""
    from scipy.ndimage import median_filter
    from scipy.signal import welch

    samples = track.samples(track.start_s, round((track.end_s - track.start_s) * RATE_HZ))
    power = welch(samples, RATE_HZ, nperseg=min(RATE_HZ, len(samples)))[1][round(_HIGH_PASS_HZ) :]
    lines = power[power > _LINE_RATIO * median_filter(power, _LINE_WIDTH_HZ)]
    return bool(lines.sum() > _MAX_HUM * power.sum())


def _is_like(first: SoundTrack, second: SoundTrack) -> bool:
    """Return True if a track is a copy of another one, with any factor and sign."""
    start_s, end_s = min(first.start_s, second.start_s), max(first.end_s, second.end_s)
    products = np.zeros(3)
    for block_s in np.arange(start_s, end_s, _BATCH_SAMPLES / RATE_HZ).tolist():
        one, two = first.samples(block_s, _BATCH_SAMPLES), second.samples(block_s, _BATCH_SAMPLES)
        products += one @ one, two @ two, one @ two
    return bool(products[2] ** 2 >= _LIKE_CORRELATION**2 * products[0] * products[1])


def _read_tracks(
    camera: str, videos: Sequence[VideoFile], times_ns: IntArray, *, separate: bool
) -> list[SoundTrack]:
    """Return the mono mix of the first stream, or each channel of each stream, over all chapters."""
    chapters: dict[str, list[tuple[Path, SoundTrack]]] = {}
    first = 0
    for video in videos:
        clock = clock_of_chapter(video.times_ns(), times_ns[first : first + len(video.pts)])
        first += len(video.pts)
        shifts_s = [float(shift * video.time_base) for _, shift in video.restarts]
        for track in _read_file(video.path, video.part, shifts_s, separate=separate):
            in_time = _without_slow_sound(track, clock)
            pieces = tuple(moved for piece in in_time.pieces for moved in _moved(piece, clock))
            chapters.setdefault(track.name, []).append((video.path, replace(in_time, pieces=pieces)))
    return [_joined(camera, tracks, len(videos)) for tracks in chapters.values()]


def _without_slow_sound(track: SoundTrack, clock: ChapterClock) -> SoundTrack:
    """Return a track without its sound if the pictures of the file are played at another speed."""
    if not track.pieces or abs(clock.rate - 1.0) <= _MAX_RATE_ERROR:
        return track
    slower = f"the file plays its pictures {1.0 / clock.rate:.3g} times slower than they were taken"
    problem = f"{slower}, so the times of its sound are unknown"
    return replace(track, pieces=(), recorder=None, problem=problem, notes=())


def _joined(camera: str, chapters: Sequence[tuple[Path, SoundTrack]], count: int) -> SoundTrack:
    """Return one track of a camera.

    Args:
        camera: Name of the camera.
        chapters: The file and the track, on the clock of the camera, of each chapter that has it.
        count: Number of all chapters.
    """
    tracks = [track for _, track in chapters]
    pieces = [piece for track in tracks for piece in track.pieces]
    notes = [f"{path.name}: {note}" for path, track in chapters for note in track.notes]
    problems = [
        f"{path.name}: {track.problem}" if count > 1 else track.problem
        for path, track in chapters
        if track.problem
    ]
    recorders = [track.recorder for track in tracks if track.recorder is not None]
    joined = SoundTrack(
        camera=camera,
        name=tracks[0].name,
        channels=max(track.channels for track in tracks),
        problem="; ".join(problems),
        notes=tuple(notes),
    )
    if not pieces:
        return joined
    joined = replace(
        joined,
        pieces=_without_overlaps(pieces),
        top_hz=min(RATE_HZ / 2, *(each.rate_hz / 2 for each in recorders)),
        recorder=recorders[0],
        problem="",
        notes=(*notes, *problems),
    )
    if not (joined.levels()[1] > _SILENCE_LSB).any():
        return replace(joined, pieces=(), recorder=None, problem="the sound is silent")
    return joined


def _moved(piece: SoundPiece, clock: ChapterClock) -> Iterator[SoundPiece]:
    """Yield a piece on the clock of the camera, in parts if the clocks run at different rates."""
    step = len(piece.samples) if clock.rate == 1.0 else _BATCH_SAMPLES
    for first in range(0, len(piece.samples), max(step, 1)):
        yield SoundPiece(clock.camera_s(piece.start_s + first / RATE_HZ), piece.samples[first : first + step])


def _without_overlaps(pieces: list[SoundPiece]) -> tuple[SoundPiece, ...]:
    """Return the pieces in the order of time. What a later piece repeats of an earlier one is cut off."""
    out: list[SoundPiece] = []
    end_s = -np.inf
    for piece in sorted(pieces, key=lambda each: each.start_s):
        excess = max(0, round((end_s - piece.start_s) * RATE_HZ)) if out else 0
        if excess < len(piece.samples):
            out.append(SoundPiece(piece.start_s + excess / RATE_HZ, piece.samples[excess:]))
            end_s = out[-1].end_s
    return tuple(out)


def read_sound_file(path: Path) -> SoundTrack:
    """Read the mono mix of the first sound stream of one file. The times are those of the file."""
    (mix,) = _read_file(path, None, (), separate=False)
    return mix


def _read_file(
    path: Path, part: tuple[int, int] | None, shifts_s: Sequence[float], *, separate: bool
) -> Iterator[SoundTrack]:
    """Yield the mono mix of the first stream of a file, or each channel of each stream.

    Args:
        path: Path of the file.
        part: First byte, and the byte after the last byte, of the recording in the file; None for all bytes.
        shifts_s: For each place at which the times start again, what is added to the times after it, seconds.
        separate: True for the channels, False for the mono mix.
    """
    with open_container(path, part) as container:
        streams = [each for each in container.streams.audio if each.codec_context is not None]
        channels = sum(stream.codec_context.channels for stream in streams)
        read = streams[: None if separate else 1]
        readers = {each.index: _PieceReader(shifts_s, separate=separate) for each in read}
        broken = _decode(container, readers) if readers else ""
        if not readers and not separate:
            has_sound = bool(container.streams.audio)
            problem = "there is no decoder for its sound" if has_sound else "the video has no sound"
            yield SoundTrack(camera="", channels=0, problem=problem)
        for number, (stream, reader) in enumerate(zip(streams, readers.values(), strict=False), start=1):
            blocks = reader.finish()
            count = max((len(samples) for _, samples in blocks), default=0 if separate else 1)
            for index in range(count):
                pieces = [SoundPiece(start_s, each[index]) for start_s, each in blocks if index < len(each)]
                gaps = f"the sound has {len(pieces) - 1} gap{'s' if len(pieces) > 2 else ''}"
                yield SoundTrack(
                    camera="",
                    name=f"channel {index + 1} of sound track {number}" if separate else "",
                    channels=channels,
                    pieces=tuple(pieces),
                    recorder=recorder_of(container, stream),
                    problem="" if pieces else broken or "its sound track is empty",
                    notes=(*([gaps] if len(pieces) > 1 else []), *([broken] if pieces and broken else [])),
                )


def recorder_of(container: InputContainer, stream: AudioStream) -> Recorder:
    """Read what an opened file says about the device and the encoder of its sound."""
    metadata = {key.lower(): value for key, value in container.metadata.items()}
    model = " ".join(metadata[key] for key in _MODEL_KEYS if metadata.get(key))
    # The first part of a GoPro's firmware version names the camera: HD5.02, H19.03.
    firmware = re.match(r"^(H[A-Z]?\d+)\.", metadata.get("firmware", ""))
    if not model and firmware:
        model = firmware.group(1)
    encoder = (
        container.format.name,
        metadata.get("major_brand", ""),
        metadata.get("encoder", ""),
        stream.codec_context.name,
        str(stream.metadata.get("handler_name", "")).strip(),
        str(stream.codec_context.layout.name),
    )
    return Recorder(model=model, encoder=encoder, rate_hz=int(stream.codec_context.sample_rate or 0))


def _decode(container: InputContainer, readers: Mapping[int, _PieceReader]) -> str:
    """Decode all sound of the streams with these indices. Packets that are damaged are skipped.

    Returns:
        A note about the damage; empty without damage.
    """
    import av

    for stream in container.streams:
        if stream.index not in readers:  # the demuxer skips it
            with contextlib.suppress(AttributeError):
                stream.discard = av.stream.Discard.all
    damaged, reason = 0, ""
    try:
        for packet in container.demux([container.streams[index] for index in readers]):
            try:
                for frame in packet.decode():
                    readers[packet.stream.index].add(cast("AudioFrame", frame))
            except av.error.FFmpegError as error:
                damaged, reason = damaged + 1, error_reason(error)
    except av.error.FFmpegError as error:
        return f"the sound breaks off ({error_reason(error)})"
    return f"{damaged} packets of the sound are damaged ({reason})" if damaged else ""


class _PieceReader:
    """Joins decoded frames to pieces and converts them to `RATE_HZ`.

    Args:
        shifts_s: For each place at which the times start again, what is added to the times after it, seconds.
        separate: True to keep the channels; False for their mono mix.
    """

    def __init__(self, shifts_s: Sequence[float], *, separate: bool) -> None:
        self._shifts_s = [0.0, *shifts_s]
        self._separate = separate
        self._pieces: list[tuple[float, npt.NDArray[np.int16]]] = []
        self._parts: list[npt.NDArray[np.int16]] = []
        self._resampler: Any = None
        self._format: tuple[object, ...] = ()
        self._start_s = 0.0
        self._end_s = 0.0
        self._count = 0

    def add(self, frame: AudioFrame) -> None:
        """Add a frame. A jump of the timestamps, or another format, starts a new piece."""
        if not frame.samples or not frame.sample_rate:
            return
        kind = (frame.sample_rate, frame.format.name, frame.layout.name)
        time_s = self._end_s if frame.time is None else float(frame.time) + self._shifts_s[0]
        if self._count and time_s < self._end_s - _MIN_RESTART_S and len(self._shifts_s) > 1:
            time_s += self._shifts_s[1] - self._shifts_s.pop(0)
        if kind != self._format or abs(time_s - self._end_s) > _MAX_JUMP_S:
            self._close()
            self._open(kind, time_s)
        self._count += frame.samples
        self._end_s = self._start_s + self._count / frame.sample_rate
        frame.pts = None
        self._resample(frame)

    def finish(self) -> list[tuple[float, npt.NDArray[np.int16]]]:
        """Return start (seconds) and samples (channels,N) of all pieces."""
        self._close()
        return self._pieces

    def _open(self, kind: tuple[object, ...], time_s: float) -> None:
        import av

        layout = kind[2] if self._separate else "mono"
        self._resampler = av.AudioResampler(format="s16p", layout=layout, rate=RATE_HZ)
        self._format, self._start_s, self._end_s, self._count = kind, time_s, time_s, 0

    def _close(self) -> None:
        if self._resampler is not None:
            self._resample(None)
        if any(part.shape[1] for part in self._parts):
            samples = _filtered(np.concatenate(self._parts, axis=1))
            count = min(_FADE_SAMPLES, samples.shape[1] // 2)
            fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
            samples[:, :count] = np.rint(samples[:, :count] * fade)
            samples[:, samples.shape[1] - count :] = np.rint(
                samples[:, samples.shape[1] - count :] * fade[::-1]
            )
            self._pieces.append((self._start_s, samples))
        self._parts, self._resampler, self._format = [], None, ()

    def _resample(self, frame: AudioFrame | None) -> None:
        self._parts += [out.to_ndarray() for out in self._resampler.resample(frame)]


def _filtered(samples: npt.NDArray[np.int16]) -> npt.NDArray[np.int16]:
    """Return samples (channels,N) without the low frequencies."""
    # Imported here, because the import takes a second and many captures have no sound.
    from scipy.signal import sosfilt, sosfilt_zi

    high_pass, out = _high_pass(), np.empty_like(samples)
    state = sosfilt_zi(high_pass)[:, None, :] * samples[:, :1].astype(np.float64)
    # The same filter delays the sound of all cameras alike. The constant prevents tiny numbers, which are
    # slow.
    for first in range(0, samples.shape[1], _FILTER_SAMPLES):
        part = slice(first, first + _FILTER_SAMPLES)
        filtered, state = sosfilt(high_pass, samples[:, part].astype(np.float64) + 1e-3, zi=state)
        out[:, part] = np.clip(np.rint(filtered), -32768, 32767)
    return out


@cache
def _high_pass() -> FloatArray:
    """Return the coefficients of the filter with the limit `_HIGH_PASS_HZ`."""
    from scipy.signal import butter

    return np.asarray(butter(4, _HIGH_PASS_HZ, "highpass", fs=RATE_HZ, output="sos"))
