"""Estimate the clocks of all cameras of a capture from their sound."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture.frame_index import index_videos
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.clocks.clock_pair import CRYSTAL_SIGMA_PPM
from bodycap_batch.clocks.container_times import (
    ContainerTime,
    ExpectedOffset,
    are_dates_apart,
    describe_difference,
    duration_text,
    expected_offset,
    read_container_time,
)
from bodycap_batch.clocks.joint_offsets import (
    UNLIKE_SIGMA_S,
    WAY_SIGMA_S,
    JointClock,
    camera_pairs,
    connected_cameras,
    solve_clocks,
)
from bodycap_batch.clocks.pair_offsets import MAX_DRIFT_PPM, PairOffset, measure_channels
from bodycap_batch.clocks.phase_correlation import PEAK_WIDTH_S
from bodycap_batch.clocks.recorders import Recorder
from bodycap_batch.clocks.sound_track import SoundTrack, read_channels, read_sound_track
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import ClockSource

STATED_SIGMA_S = 1.0 / 30.0
"""Standard deviation of a stated offset, seconds. Origin: a clap is found to a frame or so in each video."""
_MAX_SIGMAS = 3.0
"""Maximum difference of a stated offset from that of the sound, in standard deviations of the latter."""
_TURNED_TOLERANCE_S = 0.05
"""Maximum difference, seconds, of a stated offset with the sign turned from that of the sound. Origin: a clap
is found to a frame or so in each video."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """The clock of one camera: common time = camera time · (1 + drift_ppm · 1e-6) + offset_s.

    The common time is that of the reference camera.

    Attributes:
        camera: Name of the camera.
        offset_s: Offset at camera time 0, seconds; None if it is unknown.
        sigma_s: Standard deviation of the offset, seconds; None if it is unknown.
        drift_ppm: Drift, parts per million; 0 if it was not measured.
        drift_sigma_ppm: Standard deviation of the drift.
        source: ``sound``; ``motion``; ``stated``: in the job or the calibration; ``common``: the reference
            camera, and cameras with the same trigger; ``none``: unknown.
        covariance: (2,2) covariance of offset (seconds) and drift (ppm); None if it is unknown.
        reasons: Why the sound gives no clock, and notes about the sound.
        contradictions: What contradicts the clock.
        is_contradicted: True if the motion contradicts the clock.
        against_stated: How the motion contradicts the stated offset; empty if it does not.
    """

    camera: str
    offset_s: float | None
    sigma_s: float | None
    drift_ppm: float = 0.0
    drift_sigma_ppm: float = CRYSTAL_SIGMA_PPM
    source: ClockSource
    covariance: FloatArray | None = None
    reasons: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    is_contradicted: bool = False
    against_stated: str = ""

    def sigma_at(self, camera_s: float) -> float | None:
        """Return the standard deviation of the common time at a camera time, seconds; None if unknown."""
        if self.covariance is None:
            return self.sigma_s
        row = np.array([1.0, 1e-6 * camera_s])
        return float(np.sqrt(row @ self.covariance @ row))


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimates:
    """The clocks of all cameras of a capture.

    Attributes:
        reference: Name of the reference camera.
        cameras: The clock of each camera, in the order of the capture.
        pairs: What the sound of each pair of cameras gives, with the correlation curve and the offsets of the
            windows.
    """

    reference: str
    cameras: tuple[ClockEstimate, ...]
    pairs: tuple[PairOffset, ...] = field(default=(), repr=False)

    def camera(self, name: str) -> ClockEstimate:
        """Return the clock of a camera.

        Raises:
            KeyError: There is no camera with this name.
        """
        for clock in self.cameras:
            if clock.camera == name:
                return clock
        raise KeyError(name)


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
        first_frame_s: Time of the first frame on the clock of the camera, seconds.
        end_s: End of the sound, or of the pictures without usable sound, on the clock of the camera, seconds.
        frames: Number of frames.
    """

    camera: str
    sound_start_s: float | None
    problem: str
    notes: tuple[str, ...]
    recorder: Recorder | None
    start: ContainerTime
    first_frame_s: float
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

    def expected(self) -> dict[tuple[str, str], ExpectedOffset | None]:
        """Return the offset of each pair of cameras according to the containers."""
        start = {recording.camera: recording.start for recording in self.recordings}
        return {pair: expected_offset(start[pair[0]], start[pair[1]]) for pair in camera_pairs(list(start))}


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
        expected = found.expected()
        measured: dict[tuple[str, str], PairOffset] = {}

        def measure(pair: tuple[str, str]) -> PairOffset:
            prior = expected[pair]
            limits = _offset_through(reference, pair, measured, tracks)
            if limits is None and prior is not None:
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
        heard = measure_all(camera_pairs([name for name, usable in tracks.items() if usable]))
        if len(heard) < len(spec.cameras) and sum(mix.channels > 0 for _, mix in read) > 1:
            # The mixes of several cameras that are heard resemble each other: they need no other channels.
            lost = [
                (camera, mix)
                for camera, (_, mix) in zip(spec.cameras, read, strict=True)
                if mix.channels > 1 and (camera.name not in heard or len(heard) == 1)
            ]
            tracks |= zip((mix.camera for _, mix in lost), pool.map(_read_channels, lost), strict=True)
            pairs = camera_pairs([name for name, usable in tracks.items() if usable])
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
            pairs=tuple(measured[pair] for pair in camera_pairs(list(tracks)) if pair in measured),
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


def estimate_clocks(spec: CaptureConfig, threads: int | None = None) -> ClockEstimates:
    """Estimate the clocks of all cameras of a capture from their sound.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    return combine_evidence(spec, measure_sound(spec, threads))


def _read_recording(config: CameraConfig) -> tuple[Recording, SoundTrack]:
    videos = index_videos(config.video, 1)
    times_ns = join_chapters(videos, config.timestamps).times_ns
    track = read_sound_track(config.name, videos, times_ns)
    first_frame_s = int(times_ns[0]) / 1e9
    recording = Recording(
        camera=config.name,
        sound_start_s=track.start_s if track.pieces else None,
        problem=track.problem,
        notes=track.notes,
        recorder=track.recorder,
        start=read_container_time(videos, first_frame_s),
        first_frame_s=first_frame_s,
        end_s=track.end_s if track.pieces else int(times_ns[-1]) / 1e9,
        frames=len(times_ns),
    )
    return recording, track


def _read_channels(camera: tuple[CameraConfig, SoundTrack]) -> list[SoundTrack]:
    config, mix = camera
    videos = index_videos(config.video, 1)
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


def combine_evidence(spec: CaptureConfig, evidence: SoundEvidence) -> ClockEstimates:
    """Solve the clocks from the pairs of cameras, and compare them with all that is stated.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        evidence: What the sound says; empty for a capture with one camera.
    """
    reference = spec.reference_camera().name
    if not evidence.recordings:
        only = ClockEstimate(
            camera=reference, offset_s=0.0, sigma_s=0.0, drift_sigma_ppm=0.0, source="common"
        )
        return ClockEstimates(reference=reference, cameras=(only,))
    recordings = {recording.camera: recording for recording in evidence.recordings}
    pairs, expected = evidence.pairs, evidence.expected()
    accepted = [pair for pair in pairs if pair.accepted]
    starts_s = {
        name: recording.sound_start_s
        for name, recording in recordings.items()
        if recording.sound_start_s is not None
    }
    joint = solve_clocks(
        reference,
        accepted,
        starts_s,
        {name: _floor_s(recordings[reference], recordings[name]) for name in starts_s},
    )
    stated = stated_offsets(spec, reference)
    triggered = _triggered_with(spec, reference)
    clocks = []
    for name, recording in recordings.items():
        contradictions = [
            f"the sound of {pair.first} and {pair.second} contradicts that of the other pairs by "
            f"{1e3 * residual:+.1f} ms; it is not used"
            for pair, residual in joint.dropped
            if name in (pair.first, pair.second)
        ]
        if name == reference:
            clocks.append(
                ClockEstimate(
                    camera=name, offset_s=0.0, sigma_s=0.0, drift_sigma_ppm=0.0, source="common",
                    covariance=np.zeros((2, 2)), reasons=recording.notes,
                    contradictions=tuple(contradictions),
                )
            )  # fmt: skip
            continue
        reasons = recording.notes
        best = joint.clocks.get(name)
        if best is not None:
            contradictions += _stated_contradictions(stated.get(name), best)
            contradictions += _date_contradictions(name, accepted, expected)
        else:
            reasons = (*_why_none(name, reference, recordings, pairs, expected), *reasons)
        clocks.append(_camera_clock(name, best, stated.get(name), name in triggered, reasons, contradictions))
    return ClockEstimates(reference=reference, cameras=tuple(clocks), pairs=pairs)


def _camera_clock(
    name: str,
    clock: JointClock | None,
    stated_s: float | None,
    is_triggered: bool,
    reasons: Sequence[str],
    contradictions: Sequence[str],
) -> ClockEstimate:
    """Return the clock of a camera from the best source that there is."""
    unknown = ClockEstimate(
        camera=name,
        offset_s=None,
        sigma_s=None,
        source="none",
        reasons=tuple(reasons),
        contradictions=tuple(contradictions),
    )
    if is_triggered:
        return replace(unknown, offset_s=stated_s or 0.0, sigma_s=0.0, drift_sigma_ppm=0.0, source="common")
    if clock is not None:
        return replace(
            unknown,
            offset_s=clock.offset_s,
            sigma_s=clock.sigma_s,
            drift_ppm=clock.drift_ppm if clock.drift_measured else 0.0,
            drift_sigma_ppm=clock.drift_sigma_ppm,
            source="sound",
            covariance=clock.covariance,
        )
    if stated_s is not None:
        return replace(unknown, offset_s=stated_s, sigma_s=STATED_SIGMA_S, source="stated")
    return unknown


def _floor_s(reference: Recording, recording: Recording) -> float:
    """Return the standard deviation of an offset that more sound does not reduce, seconds."""
    if reference.recorder is None or recording.recorder is None:
        return UNLIKE_SIGMA_S
    return WAY_SIGMA_S if recording.recorder.is_like(reference.recorder) else UNLIKE_SIGMA_S


def stated_offsets(spec: CaptureConfig, reference: str) -> dict[str, float]:
    """Return the stated offset of each camera relative to the reference camera, seconds."""
    stated = {camera.name: camera.offset_s for camera in spec.cameras}
    base = stated.pop(reference) or 0.0
    return {name: offset - base for name, offset in stated.items() if offset is not None}


def triggered_groups(spec: CaptureConfig) -> list[list[str]]:
    """Return the names of the cameras that one trigger exposes, one list for each trigger."""
    if spec.rig != "synced":
        return []
    return [[camera.name for camera in group] for group in spec.segments()]


def _triggered_with(spec: CaptureConfig, reference: str) -> set[str]:
    """Return the cameras that the trigger of the reference camera exposes, too."""
    groups = triggered_groups(spec)
    return {name for group in groups if reference in group for name in group if name != reference}


def describe_contradiction(
    stated_s: float, source: ClockSource, found_s: float, sigma_s: float, tolerance_s: float = 0.0
) -> str:
    """Return how an estimate contradicts a stated offset; "" if it does not.

    Args:
        stated_s: The stated offset relative to the reference camera, seconds.
        source: Source of the estimate.
        found_s: The estimated offset, seconds.
        sigma_s: Standard deviation of the estimate, seconds.
        tolerance_s: Difference that is no contradiction, seconds.
    """
    allowed_s = max(_MAX_SIGMAS * sigma_s, tolerance_s)
    if abs(stated_s - found_s) <= allowed_s:
        return ""
    text = f"offset_s is stated as {stated_s:.4f} s, but the {source} gives {found_s:.4f} ± {sigma_s:.4f} s"
    turned = abs(stated_s + found_s)
    if turned <= max(allowed_s, _TURNED_TOLERANCE_S) < abs(stated_s - found_s):
        text += f"; with the sign turned the {source} agrees"
    return text


def _stated_contradictions(stated_s: float | None, clock: JointClock) -> list[str]:
    """Return how a clock from the sound contradicts the stated offset, if there is one."""
    if stated_s is None:
        return []
    text = describe_contradiction(stated_s, "sound", clock.offset_s, clock.sigma_s)
    return [text] if text else []


def _date_contradictions(
    name: str,
    accepted: Sequence[PairOffset],
    expected: Mapping[tuple[str, str], ExpectedOffset | None],
) -> list[str]:
    """Return how the times in the files contradict the sound of the pairs of a camera."""
    out = []
    for pair in accepted:
        prior = expected[pair.first, pair.second]
        if prior is not None and pair.second == name and prior.contradicts(pair.offset_s):
            text = describe_difference(pair.first, pair.second, prior.offset_s - pair.offset_s)
            out.append(f"{text}, but their sound belongs together: the clock of one camera was not set")
    return out


def _gap_s(expected: ExpectedOffset, first: Recording, second: Recording) -> float:
    """Return the time between two recordings according to their files, seconds; 0 if they may overlap."""
    low_s, high_s = expected.limits()
    if second.first_frame_s + low_s > first.end_s:
        return second.first_frame_s + expected.offset_s - first.end_s
    if first.first_frame_s > second.end_s + high_s:
        return first.first_frame_s - second.end_s - expected.offset_s
    return 0.0


def _why_none(
    name: str,
    reference: str,
    recordings: Mapping[str, Recording],
    pairs: Sequence[PairOffset],
    expected: Mapping[tuple[str, str], ExpectedOffset | None],
) -> list[str]:
    """Return why the sound gives no clock for a camera."""
    own = recordings[name].problem
    if own:
        return [own]
    reasons = []
    if recordings[reference].problem:
        reasons.append(f"{reference}, the reference camera: {recordings[reference].problem}")
    connected = connected_cameras(reference, [pair for pair in pairs if pair.accepted])
    for pair in pairs:
        other = {pair.first: pair.second, pair.second: pair.first}.get(name)
        if other is None or other not in connected or pair.accepted:
            continue
        reasons.append(f"with {other}: {pair.reason}")
        prior = expected[pair.first, pair.second]
        if prior is not None and are_dates_apart(prior):
            reasons.append(
                f"according to the files, {other} was recorded {duration_text(prior.offset_s)} apart"
            )
        elif prior is not None:
            gap_s = _gap_s(prior, recordings[pair.first], recordings[pair.second])
            if gap_s > 0.0:
                reasons.append(
                    f"according to the files, the recordings of {name} and {other} do not overlap: there are "
                    f"{duration_text(gap_s)} between them"
                )
    return reasons
