"""Read the sound of a camera: mono, 16 kHz, with the time of its samples on the clock of the camera."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture.timeline import ChapterClock, clock_of_chapter
from bodycap_batch.capture.video import VideoFile, error_reason, open_container
from bodycap_batch.clocks.recorders import Recorder, recorder_of
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
"""Number of samples that are filtered at once. Evidence: none."""
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

Samples = npt.NDArray[np.float32]


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
        pieces: Sound without gaps, in the order of time. The gaps between pieces are silent.
        top_hz: Highest frequency that the recording contains, Hz: half its lowest sample rate.
        recorder: What is known about the device and the encoder; None without sound.
        problem: Reason why the sound cannot be used; empty if it can be used.
        notes: Notes for the user about gaps and damage.
    """

    camera: str
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
    """Read the sound of all chapters of a camera.

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
    pieces: list[SoundPiece] = []
    notes: list[str] = []
    problems: list[str] = []
    recorders: list[Recorder] = []
    first = 0
    for video in videos:
        clock = clock_of_chapter(video.times_ns(), times_ns[first : first + len(video.pts)])
        first += len(video.pts)
        shifts_s = [float(shift * video.time_base) for _, shift in video.restarts]
        chapter = read_sound_file(video.path, video.part, shifts_s)
        if chapter.pieces and abs(clock.rate - 1.0) > _MAX_RATE_ERROR:
            slower = f"the file plays its pictures {1.0 / clock.rate:.3g} times slower than they were taken"
            chapter = SoundTrack(camera="", problem=f"{slower}, so nothing tells the times of its sound")
        pieces += [moved for piece in chapter.pieces for moved in _moved(piece, clock)]
        notes += [f"{video.path.name}: {note}" for note in chapter.notes]
        if chapter.problem:
            problems.append(f"{video.path.name}: {chapter.problem}" if len(videos) > 1 else chapter.problem)
        if chapter.recorder is not None:
            recorders.append(chapter.recorder)
    if not pieces:
        return SoundTrack(camera=camera, problem="; ".join(problems), notes=tuple(notes))
    notes += problems
    track = SoundTrack(
        camera=camera,
        pieces=_without_overlaps(pieces),
        top_hz=min(RATE_HZ / 2, *(each.rate_hz / 2 for each in recorders)),
        recorder=recorders[0],
        notes=tuple(notes),
    )
    if not (track.levels()[1] > _SILENCE_LSB).any():
        return SoundTrack(camera=camera, problem="the sound is silent", notes=track.notes)
    return track


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


def read_sound_file(
    path: Path, part: tuple[int, int] | None = None, shifts_s: Sequence[float] = ()
) -> SoundTrack:
    """Read the sound of one file. The times are those of the file.

    Args:
        path: Path of the file.
        part: First byte, and the byte after the last byte, of the recording in the file; None for all bytes.
        shifts_s: For each place at which the times start again, what is added to the times after it, seconds.
    """
    with open_container(path, part) as container:
        stream = _audio_stream(container)
        if stream is None:
            has_sound = bool(container.streams.audio)
            problem = "there is no decoder for its sound" if has_sound else "the video has no sound"
            return SoundTrack(camera="", problem=problem)
        recorder = recorder_of(container, stream)
        reader = _PieceReader(shifts_s)
        broken = _decode(container, stream, reader)
        pieces = reader.finish()
    notes = []
    if len(pieces) > 1:
        notes.append(f"the sound has {len(pieces) - 1} gap{'s' if len(pieces) > 2 else ''}")
    if broken:
        notes.append(broken)
    return SoundTrack(
        camera="",
        pieces=tuple(pieces),
        recorder=recorder,
        problem="" if pieces else broken or "its sound track is empty",
        notes=tuple(notes) if pieces else (),
    )


def _audio_stream(container: InputContainer) -> AudioStream | None:
    """Return the first sound stream that has a decoder, and let the demuxer skip all others."""
    import av

    chosen = next((each for each in container.streams.audio if each.codec_context is not None), None)
    for stream in container.streams:
        if stream is not chosen:
            with contextlib.suppress(AttributeError):
                stream.discard = av.stream.Discard.all
    return chosen


def _decode(container: InputContainer, stream: AudioStream, reader: _PieceReader) -> str:
    """Decode all sound of a stream. Packets that are damaged are skipped.

    Returns:
        A note about the damage; empty without damage.
    """
    import av

    damaged, reason = 0, ""
    try:
        for packet in container.demux(stream):
            try:
                for frame in packet.decode():
                    reader.add(frame)
            except av.error.FFmpegError as error:
                damaged, reason = damaged + 1, error_reason(error)
    except av.error.FFmpegError as error:
        return f"the sound breaks off ({error_reason(error)})"
    return f"{damaged} packets of the sound are damaged ({reason})" if damaged else ""


class _PieceReader:
    """Joins decoded frames to pieces and converts them to mono at `RATE_HZ`."""

    def __init__(self, shifts_s: Sequence[float] = ()) -> None:
        self._shifts_s = [0.0, *shifts_s]
        self._pieces: list[SoundPiece] = []
        self._parts: list[npt.NDArray[np.int16]] = []
        self._waiting: list[npt.NDArray[np.int16]] = []
        self._resampler: Any = None
        self._state: Any = None
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
        self._keep(frame)

    def finish(self) -> list[SoundPiece]:
        """Return all pieces."""
        self._close()
        return self._pieces

    def _open(self, kind: tuple[object, ...], time_s: float) -> None:
        import av

        self._resampler = av.AudioResampler(format="s16", layout="mono", rate=RATE_HZ)
        self._format, self._start_s, self._end_s, self._count = kind, time_s, time_s, 0

    def _close(self) -> None:
        if self._resampler is not None:
            self._keep(None)
        if self._parts:
            samples = np.concatenate(self._parts)
            count = min(_FADE_SAMPLES, len(samples) // 2)
            fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
            samples[:count] = np.rint(samples[:count] * fade)
            samples[len(samples) - count :] = np.rint(samples[len(samples) - count :] * fade[::-1])
            self._pieces.append(SoundPiece(self._start_s, samples))
        self._parts, self._resampler, self._state, self._format = [], None, None, ()

    def _keep(self, frame: AudioFrame | None) -> None:
        self._waiting += [out.to_ndarray()[0] for out in self._resampler.resample(frame)]
        if frame is None or sum(map(len, self._waiting)) >= _FILTER_SAMPLES:
            self._filter()

    def _filter(self) -> None:
        """Remove the low frequencies from the samples that wait. The filter is slow for short parts."""
        samples = np.concatenate([np.zeros(0), *self._waiting])
        self._waiting = []
        if not len(samples):
            return
        # Imported here, because the import takes a second and many captures have no sound.
        from scipy.signal import sosfilt, sosfilt_zi

        high_pass = _high_pass()
        if self._state is None:
            self._state = sosfilt_zi(high_pass) * samples[0]
        # The same filter delays the sound of all cameras alike. The constant prevents tiny numbers, which are
        # slow.
        filtered, self._state = sosfilt(high_pass, samples + 1e-3, zi=self._state)
        self._parts.append(np.clip(np.rint(filtered), -32768, 32767).astype(np.int16))


@cache
def _high_pass() -> FloatArray:
    """Return the coefficients of the filter with the limit `_HIGH_PASS_HZ`."""
    from scipy.signal import butter

    return np.asarray(butter(4, _HIGH_PASS_HZ, "highpass", fs=RATE_HZ, output="sos"))
