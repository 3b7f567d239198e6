"""Solve the clocks of all cameras of a capture from what their sound says, and from what is stated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.clocks.joint_offsets import (
    CRYSTAL_SIGMA_PPM,
    UNLIKE_SIGMA_S,
    WAY_SIGMA_S,
    JointClock,
    solve_clocks,
)
from bodycap_batch.clocks.pair_offsets import PairOffset
from bodycap_batch.clocks.reasons import contradictions_of_sound, dropped_pairs, reasons_without_clock
from bodycap_batch.clocks.sound_evidence import Recording, SoundEvidence, measure_sound
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import ClockSource

STATED_SIGMA_S = 1.0 / 30.0
"""Standard deviation of a stated offset, seconds. Origin: a clap is found to a frame or so in each video."""


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
    offset_s: float | None = None
    sigma_s: float | None = None
    drift_ppm: float = 0.0
    drift_sigma_ppm: float = CRYSTAL_SIGMA_PPM
    source: ClockSource = "none"
    covariance: FloatArray | None = None
    reasons: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()
    is_contradicted: bool = False
    against_stated: str = ""

    def solved(self, clock: JointClock, source: ClockSource) -> ClockEstimate:
        """Return the estimate with a solved clock from this source."""
        return replace(
            self,
            offset_s=clock.offset_s,
            sigma_s=clock.sigma_s,
            drift_ppm=clock.drift_ppm if clock.drift_measured else 0.0,
            drift_sigma_ppm=clock.drift_sigma_ppm,
            source=source,
            covariance=clock.covariance,
        )

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
        return {clock.camera: clock for clock in self.cameras}[name]


def estimate_clocks(spec: CaptureConfig, threads: int | None = None) -> ClockEstimates:
    """Estimate the clocks of all cameras of a capture from their sound.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    return combine_evidence(spec, measure_sound(spec, threads))


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
    recordings = evidence.by_camera()
    starts_s = {
        name: recording.sound_start_s
        for name, recording in recordings.items()
        if recording.sound_start_s is not None
    }
    floors_s = {name: _floor_s(recordings[reference], recordings[name]) for name in starts_s}
    joint = solve_clocks(reference, evidence.accepted(), starts_s, floors_s)
    stated = stated_offsets(spec, reference)
    common = {reference}.union(*(group for group in triggered_groups(spec) if reference in group))
    clocks = []
    for name, recording in recordings.items():
        best = joint.clocks.get(name)
        reasons, contradictions = recording.notes, tuple(dropped_pairs(name, joint))
        if name != reference:
            contradictions += tuple(contradictions_of_sound(name, evidence, joint, stated.get(name)))
        if best is None:
            reasons = (*reasons_without_clock(name, reference, evidence), *reasons)
        clock = ClockEstimate(camera=name, reasons=reasons, contradictions=contradictions)
        if name in common:
            clock = replace(
                clock, offset_s=stated.get(name, 0.0), sigma_s=0.0, drift_sigma_ppm=0.0, source="common"
            )
        elif best is not None:
            clock = clock.solved(best, "sound")
        elif name in stated:
            clock = replace(clock, offset_s=stated[name], sigma_s=STATED_SIGMA_S, source="stated")
        clocks.append(clock)
    return ClockEstimates(reference=reference, cameras=tuple(clocks), pairs=evidence.pairs)


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
