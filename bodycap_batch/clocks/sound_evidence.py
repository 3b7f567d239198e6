"""Compare the sound of all cameras of a capture."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations

from bodycap_batch.capture.frame_index import index_videos
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.clocks.container_times import (
    ContainerTime,
    ExpectedOffset,
    expected_offset,
    read_container_time,
)
from bodycap_batch.clocks.joint_offsets import MAX_DRIFT_PPM, connected_cameras
from bodycap_batch.clocks.pair_offsets import PairOffset, measure_channels
from bodycap_batch.clocks.phase_correlation import PEAK_WIDTH_S
from bodycap_batch.clocks.sound_track import Recorder, SoundTrack, read_channels, read_sound_track
from bodycap_batch.config.models import CameraConfig, CaptureConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What the files of one camera say about its clock.

    Attributes:
        camera: Name of the camera.
        sound_start_s: Start of the sound on the clock of the camera, seconds; None without usable sound.
        problem: Reason why the sound cannot be used; empty if it can be used.
        notes: Notes for the user about the sound.
        recorder: Device and encoder of the sound; None without sound.
        start: Start of the recording according to the container.
        end_s: End of the sound, or of the pictures without usable sound, on the clock of the camera, seconds.
        frames: Number of frames.
    """

    camera: str
    sound_start_s: float | None
    problem: str
    notes: tuple[str, ...]
    recorder: Recorder | None
    start: ContainerTime
    end_s: float
    frames: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundEvidence:
    """What the sound of all cameras says about their clocks.

    Attributes:
        recordings: The recording of each camera, in the order of the capture.
        pairs: What the sound of each pair of cameras gives, with the correlation curve and the offsets of the
            windows.
    """

    recordings: tuple[Recording, ...] = ()
    pairs: tuple[PairOffset, ...] = ()

    def by_camera(self) -> dict[str, Recording]:
        """Return the recording of each camera, by camera name."""
        return {recording.camera: recording for recording in self.recordings}

    def accepted(self) -> list[PairOffset]:
        """Return the pairs whose offset is determined."""
        return [pair for pair in self.pairs if pair.accepted]

    def expected(self, first: str, second: str) -> ExpectedOffset | None:
        """Return the offset of two cameras according to their containers; None if it is unknown."""
        recordings = self.by_camera()
        return expected_offset(recordings[first].start, recordings[second].start)


def measure_sound(spec: CaptureConfig, threads: int | None = None) -> SoundEvidence:
    """Compare the sound of all pairs of cameras.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    with ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1) as pool:
        read = list(pool.map(_read_recording, spec.cameras))
        found = SoundEvidence(recordings=tuple(recording for recording, _ in read))
        tracks = {mix.camera: [] if mix.problem else [mix] for _, mix in read}
        measured: dict[tuple[str, str], PairOffset] = {}

        def measure(pair: tuple[str, str]) -> PairOffset:
            limits = _offset_through(reference, pair, measured, tracks)
            if limits is None and (prior := found.expected(*pair)) is not None:
                limits = prior.limits()
            return measure_channels(tracks[pair[0]], tracks[pair[1]], limits)

        def measure_all(pairs: Sequence[tuple[str, str]]) -> list[str]:
            direct = [pair for pair in pairs if reference in pair]
            for some in (direct, [pair for pair in pairs if pair not in direct]):
                for pair, offset in zip(some, list(pool.map(measure, some)), strict=True):
                    if offset.accepted or pair not in measured:
                        measured[pair] = offset
            return connected_cameras(reference, [pair for pair in measured.values() if pair.accepted])

        reference = spec.reference_camera().name
        heard = measure_all(list(combinations((name for name, usable in tracks.items() if usable), 2)))
        if len(heard) < len(spec.cameras) and sum(mix.channels > 0 for _, mix in read) > 1:
            # The mixes of several cameras that are heard resemble each other: they need no other channels.
            lost = [
                (camera, mix)
                for camera, (_, mix) in zip(spec.cameras, read, strict=True)
                if mix.channels > 1 and (camera.name not in heard or len(heard) == 1)
            ]
            tracks |= zip((mix.camera for _, mix in lost), pool.map(_read_channels, lost), strict=True)
            pairs = combinations((name for name, usable in tracks.items() if usable), 2)
            measure_all(
                [
                    pair
                    for pair in pairs
                    if (pair[0] in heard) != (pair[1] in heard)
                    and (pair not in measured or any(len(tracks[name]) > 1 for name in pair))
                ]
            )
        return SoundEvidence(
            recordings=tuple(
                _with_channel(each, tracks[each.camera], measured.values()) for each in found.recordings
            ),
            pairs=tuple(measured[pair] for pair in combinations(tracks, 2) if pair in measured),
        )


def _offset_through(
    reference: str,
    pair: tuple[str, str],
    measured: Mapping[tuple[str, str], PairOffset],
    tracks: Mapping[str, Sequence[SoundTrack]],
) -> tuple[float, float] | None:
    """Return limits of the offset of a pair, seconds, from the offsets of both to the reference camera.

    None if one of them is not measured. The limits contain every drift that is possible.
    """
    offsets_s = []
    for name in pair:
        through = next((each for key, each in measured.items() if set(key) == {name, reference}), None)
        if through is None or not through.accepted:
            return None
        offsets_s.append(through.offset_s if through.first == reference else -through.offset_s)
    sounds = [tracks[name][0] for name in pair]
    longest_s = max(abs(time) for sound in sounds for time in (sound.start_s, sound.end_s))
    middle_s, reach_s = offsets_s[1] - offsets_s[0], PEAK_WIDTH_S + 2e-6 * MAX_DRIFT_PPM * longest_s
    return middle_s - reach_s, middle_s + reach_s


def _read_recording(config: CameraConfig) -> tuple[Recording, SoundTrack]:
    videos = index_videos(config.video)
    times_ns = join_chapters(videos, config.timestamps).times_ns
    track = read_sound_track(config.name, videos, times_ns)
    recording = Recording(
        camera=config.name,
        sound_start_s=track.start_s if track.pieces else None,
        problem=track.problem,
        notes=track.notes,
        recorder=track.recorder,
        start=read_container_time(videos, int(times_ns[0]) / 1e9),
        end_s=track.end_s if track.pieces else int(times_ns[-1]) / 1e9,
        frames=len(times_ns),
    )
    return recording, track


def _read_channels(camera: tuple[CameraConfig, SoundTrack]) -> list[SoundTrack]:
    config, mix = camera
    videos = index_videos(config.video)
    return read_channels(mix, videos, join_chapters(videos, config.timestamps).times_ns)


def _with_channel(
    recording: Recording, tracks: Sequence[SoundTrack], pairs: Iterable[PairOffset]
) -> Recording:
    """Return a recording with the sound that was compared, and a note if it is not the mono mix."""
    if not tracks or (not tracks[0].name and len(tracks) == 1):
        return recording
    names = [
        name
        for pair in pairs
        for camera, name in zip((pair.first, pair.second), pair.channels, strict=True)
        if pair.accepted and camera == recording.camera and name
    ]
    why = recording.problem or "the mono mix of the first sound track agrees with no other camera"
    notes = [f"the clock comes from {name} ({why})" for name in dict.fromkeys(names)]
    return replace(
        recording,
        sound_start_s=tracks[0].start_s,
        end_s=tracks[0].end_s,
        recorder=tracks[0].recorder,
        problem="",
        notes=(*recording.notes, *notes),
    )
