"""Solve the clocks of all cameras of a capture from what their sound says, and from what is stated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from bodycap_batch.clocks.joint_offsets import (
    CRYSTAL_SIGMA_PPM,
    UNLIKE_SIGMA_S,
    WAY_SIGMA_S,
    solve_clocks,
)
from bodycap_batch.clocks.pair_offsets import PairOffset
from bodycap_batch.clocks.reasons import contradictions_of_sound, dropped_pairs, reasons_without_clock
from bodycap_batch.clocks.sound_evidence import Recording, SoundEvidence, measure_sound
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.model.camera_clock import ClockRelation, ClockSource

STATED_SIGMA_S = 1.0 / 30.0
"""Standard deviation of a stated offset, seconds. Origin: a clap is found to a frame or so in each video."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate(ClockRelation):
    """The clock of one camera relative to the reference camera, whose time is the common time.

    The notes say what contradicts the clock. It is contradicted if the motion contradicts it.

    Attributes:
        camera: Name of the camera.
        reasons: Why the sound gives no clock, and notes about the sound.
        against_stated: How the motion contradicts the stated offset; empty if it does not.
    """

    camera: str
    drift_sigma_ppm: float = CRYSTAL_SIGMA_PPM
    source: ClockSource = "none"
    reasons: tuple[str, ...] = ()
    against_stated: str = ""


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
        only = ClockEstimate(camera=reference, drift_sigma_ppm=0.0, source="common")
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
        clock = ClockEstimate(camera=name, reasons=reasons)
        if name in common:
            clock = replace(clock, offset_s=stated.get(name, 0.0), drift_sigma_ppm=0.0, source="common")
        elif best is not None:
            clock = replace(clock, **best.values())
        elif name in stated:
            clock = replace(clock, offset_s=stated[name], sigma_s=STATED_SIGMA_S, source="stated")
        clocks.append(replace(clock, notes=contradictions))
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
