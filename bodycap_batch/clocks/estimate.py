"""Estimate the clocks of all cameras of a capture from their sound."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.capture.timeline import join_chapters
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
from bodycap_batch.clocks.pair_offsets import CRYSTAL_SIGMA_PPM, PairOffset, measure_pair
from bodycap_batch.clocks.sound_track import SoundTrack, read_sound_track
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.mounts import REFERENCE_ROLES
from bodycap_batch.core.arrays import FloatArray

ClockSource = Literal["sound", "stated", "common", "none"]

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
        source: ``sound``; ``stated``: in the job or the calibration; ``common``: the reference camera, and
            cameras with the same trigger; ``none``: unknown.
        covariance: (2,2) covariance of offset (seconds) and drift (ppm); None if it is unknown.
        reasons: Why the sound gives no clock, and notes about the sound.
        contradictions: What contradicts the clock.
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


@dataclass(frozen=True, slots=True)
class _Recording:
    """What is read from the files of one camera."""

    track: SoundTrack
    start: ContainerTime


def estimate_clocks(spec: CaptureConfig, threads: int | None = None) -> ClockEstimates:
    """Estimate the clocks of all cameras of a capture from their sound.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    names = [camera.name for camera in spec.cameras]
    with ThreadPoolExecutor(max_workers=threads or os.cpu_count() or 1) as pool:
        recordings = dict(zip(names, pool.map(_read_recording, spec.cameras), strict=True))
        usable = [name for name in names if not recordings[name].track.problem]
        expected = {
            pair: expected_offset(recordings[pair[0]].start, recordings[pair[1]].start)
            for pair in camera_pairs(names)
        }

        def measure(pair: tuple[str, str]) -> PairOffset:
            prior = expected[pair]
            limits = None if prior is None else prior.limits()
            return measure_pair(recordings[pair[0]].track, recordings[pair[1]].track, limits)

        pairs = tuple(pool.map(measure, camera_pairs(usable)))
    return _combine(spec, recordings, expected, pairs)


def reference_camera(spec: CaptureConfig) -> str:
    """Return the name of the torso's camera; of the first camera if there is none on the torso."""
    for role in REFERENCE_ROLES:
        for camera in spec.cameras:
            if camera.role == role:
                return camera.name
    return spec.cameras[0].name


def _read_recording(config: CameraConfig) -> _Recording:
    videos = tuple(index_video(path, 1) for path in config.video)
    times_ns = join_chapters(videos, config.timestamps).times_ns
    return _Recording(
        read_sound_track(config.name, videos, times_ns), read_container_time(videos, int(times_ns[0]) / 1e9)
    )


def _combine(
    spec: CaptureConfig,
    recordings: Mapping[str, _Recording],
    expected: Mapping[tuple[str, str], ExpectedOffset | None],
    pairs: tuple[PairOffset, ...],
) -> ClockEstimates:
    """Solve the clocks from the pairs, and compare them with all that is stated."""
    reference = reference_camera(spec)
    accepted = [pair for pair in pairs if pair.accepted]
    tracks = {name: recording.track for name, recording in recordings.items() if recording.track.pieces}
    joint = solve_clocks(
        reference,
        accepted,
        {name: track.start_s for name, track in tracks.items()},
        {name: _floor_s(tracks.get(reference), track) for name, track in tracks.items()},
    )
    stated = _stated_offsets(spec, reference)
    triggered = _triggered_with(spec, reference)
    clocks = []
    for name in recordings:
        contradictions = [
            f"the sound of {pair.first} and {pair.second} contradicts that of the other pairs by "
            f"{1e3 * residual:+.1f} ms; it is not used"
            for pair, residual in joint.dropped
            if name in (pair.first, pair.second)
        ]
        clock = joint.clocks.get(name)
        if name == reference:
            clocks.append(
                ClockEstimate(
                    camera=name, offset_s=0.0, sigma_s=0.0, drift_sigma_ppm=0.0, source="common",
                    covariance=np.zeros((2, 2)), reasons=recordings[name].track.notes,
                    contradictions=tuple(contradictions),
                )
            )  # fmt: skip
            continue
        dates = _date_contradictions(name, accepted, expected)
        if clock is not None:
            contradictions += [*_stated_contradictions(stated.get(name), clock), *dates]
        reasons = recordings[name].track.notes
        if clock is None:
            reasons = (*_why_none(name, reference, recordings, pairs, expected), *reasons)
        clocks.append(
            _camera_clock(name, clock, stated.get(name), name in triggered, reasons, contradictions)
        )
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


def _floor_s(reference: SoundTrack | None, track: SoundTrack) -> float:
    """Return the standard deviation of an offset that more sound does not reduce, seconds."""
    if reference is None or reference.recorder is None or track.recorder is None:
        return UNLIKE_SIGMA_S
    return WAY_SIGMA_S if track.recorder.is_like(reference.recorder) else UNLIKE_SIGMA_S


def _stated_offsets(spec: CaptureConfig, reference: str) -> dict[str, float]:
    """Return the stated offset of each camera relative to the reference camera, seconds.

    A loaded job has the offset 0 for a camera without a stated one. Therefore only differences from 0 count.
    """
    stated = {camera.name: camera.offset_s or 0.0 for camera in spec.cameras}
    return {
        name: offset - stated[reference]
        for name, offset in stated.items()
        if name != reference and offset != stated[reference]
    }


def _triggered_with(spec: CaptureConfig, reference: str) -> set[str]:
    """Return the cameras that the trigger of the reference camera exposes, too."""
    if spec.rig != "synced":
        return set()
    groups = [[camera.name for camera in group] for group in spec.segments()]
    return {name for group in groups if reference in group for name in group if name != reference}


def _stated_contradictions(stated_s: float | None, clock: JointClock) -> list[str]:
    """Return how a stated offset contradicts the sound; nothing if it does not."""
    if stated_s is None or abs(stated_s - clock.offset_s) <= _MAX_SIGMAS * clock.sigma_s:
        return []
    found = f"{clock.offset_s:.4f} ± {clock.sigma_s:.4f} s"
    text = f"offset_s is stated as {stated_s:.4f} s, the sound gives {found}"
    turned = abs(stated_s + clock.offset_s)
    if turned <= max(_MAX_SIGMAS * clock.sigma_s, _TURNED_TOLERANCE_S) < abs(stated_s - clock.offset_s):
        text += "; with the sign turned the sound agrees"
    return [text]


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


def _gap_s(expected: ExpectedOffset, first: SoundTrack, second: SoundTrack) -> float:
    """Return the time between two recordings according to their files, seconds; 0 if they may overlap."""
    low_s, high_s = expected.limits()
    if second.start_s + low_s > first.end_s:
        return second.start_s + expected.offset_s - first.end_s
    if first.start_s > second.end_s + high_s:
        return first.start_s - second.end_s - expected.offset_s
    return 0.0


def _why_none(
    name: str,
    reference: str,
    recordings: Mapping[str, _Recording],
    pairs: Sequence[PairOffset],
    expected: Mapping[tuple[str, str], ExpectedOffset | None],
) -> list[str]:
    """Return why the sound gives no clock for a camera."""
    own = recordings[name].track.problem
    if own:
        return [own]
    reasons = []
    if recordings[reference].track.problem:
        reasons.append(f"{reference}, the reference camera: {recordings[reference].track.problem}")
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
            gap_s = _gap_s(prior, recordings[pair.first].track, recordings[pair.second].track)
            if gap_s > 0.0:
                reasons.append(
                    f"according to the files, the recordings of {name} and {other} do not overlap: there are "
                    f"{duration_text(gap_s)} between them"
                )
    return reasons
