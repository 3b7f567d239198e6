"""Decide which clock each camera of a capture has: stated, shared, estimated or unknown."""

from __future__ import annotations

from dataclasses import replace

from bodycap_batch.clocks.clock_pair import CRYSTAL_SIGMA_PPM
from bodycap_batch.clocks.estimate import (
    STATED_SIGMA_S,
    ClockEstimate,
    ClockEstimates,
    describe_contradiction,
    estimate_clocks,
    triggered_groups,
)
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES, CaptureClocks, ClockRelation

UNKNOWN_CLOCK_HINT = "clap once, or hop once, while all cameras record, or state offset_s"
"""What a user can do about an unknown clock."""


def decide_clocks(spec: CaptureConfig, estimates: ClockEstimates) -> CaptureClocks:
    """Decide which clock each camera has.

    A stated offset is used as it is stated; an estimate that contradicts it is noted. Without a statement,
    the estimate is used. Without an estimate, the clock is unknown.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        estimates: The clocks that were estimated from the sound and the motion.
    """
    configs = {camera.name: camera for camera in spec.cameras}
    base_s = configs[estimates.reference].offset_s or 0.0
    clocks = {
        name: _reference_clock(config)
        if name == estimates.reference
        else _clock_of(config, spec, estimates.camera(name), base_s)
        for name, config in configs.items()
    }
    for group in triggered_groups(spec):
        clocks |= _with_shared_clock({name: clocks[name] for name in group})
    return CaptureClocks(reference=estimates.reference, cameras=clocks)


def with_known_offsets(spec: CaptureConfig, clocks: CaptureClocks) -> CaptureConfig:
    """Return a capture that states the known offset of each camera, so that start_s and end_s can be applied.

    The offset of a camera with an unknown clock stays unknown.
    """
    cameras = [
        camera.model_copy(update={"offset_s": clocks.cameras[camera.name].offset_s})
        if clocks.cameras[camera.name].is_known
        else camera
        for camera in spec.cameras
    ]
    return spec.model_copy(update={"cameras": tuple(cameras)})


def clock_notes(clocks: CaptureClocks) -> list[str]:
    """Return a note for the user about each unknown or contradicted clock."""
    return [
        f"{name}: {note}"
        for name, clock in clocks.cameras.items()
        if clock.is_contradicted or not clock.is_known
        for note in clock.notes
    ]


def clocks_from_motion_notes(spec: CaptureConfig, *, with_body: bool) -> list[str]:
    """Return a note for the user about the clocks that only the motion can determine; empty without any.

    It says before the run what is missing from the results if the motion does not determine them.

    Args:
        spec: The capture block of a job, with the offset of each camera whose clock is known
            (`with_known_offsets`).
        with_body: True if the job asks for the motion of the body.
    """
    unknown = [camera.name for camera in spec.cameras if camera.offset_s is None]
    if not unknown:
        return []
    them = ", ".join(unknown)
    if not with_body:
        missing = f"the times of {them} are not those of the other cameras"
    elif spec.unplaced():
        missing = "the places of the cameras are not found and there is no motion of the body (motion.bvh)"
    elif len(spec.cameras) - len(unknown) < 2:
        missing = "there is no motion of the body (motion.bvh)"
    else:
        missing = f"the motion of the body is solved without {them}"
    return [
        f"the sound does not give the clock of {them}, so the run looks for it in the motion. If the motion "
        f"does not show it, {missing}; the map, the paths of all cameras and the report do not need it. "
        f"To be sure, {UNKNOWN_CLOCK_HINT}"
    ]


def describe_clocks(spec: CaptureConfig, *, with_body: bool, threads: int | None = None) -> list[str]:
    """Return a sentence for the user about the clock of each camera, and what may be missing without it.

    The clocks are those that are stated, or that the sound determines.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        with_body: True if the job asks for the motion of the body.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    if len(spec.cameras) < 2:
        return []
    estimates = estimate_clocks(spec, threads)
    clocks = decide_clocks(spec, estimates)
    base_s = clocks.cameras[clocks.reference].offset_s
    lines = []
    for name, clock in clocks.cameras.items():
        text = f"{name}: clock offset {describe_clock(clock, base_s)}"
        if name == clocks.reference:
            text = f"{name}: reference clock"
        elif not clock.is_known:
            reasons = "; ".join(estimates.camera(name).reasons)
            text = f"{name}: the sound does not give the clock offset ({reasons})"
        lines.append("; ".join([text, *(clock.notes if clock.is_known else ())]))
    return [*lines, *clocks_from_motion_notes(with_known_offsets(spec, clocks), with_body=with_body)]


def describe_clock(clock: ClockRelation, reference_offset_s: float = 0.0) -> str:
    """Return a clock as text for the user, relative to the reference camera.

    Args:
        clock: The clock.
        reference_offset_s: Offset of the reference camera's clock, seconds.
    """
    if not clock.is_known:
        return "unknown"
    text = f"{clock.offset_s - reference_offset_s:+.4f}"
    if clock.sigma_s:
        text += f" ± {clock.sigma_s:.4f}"
    text += " s"
    if clock.drift_ppm:
        text += f", {clock.drift_ppm:+.1f} ± {clock.drift_sigma_ppm:.1f} ppm"
    return f"{text} ({clock.source})"


def _reference_clock(config: CameraConfig) -> ClockRelation:
    return ClockRelation(
        offset_s=config.offset_s or 0.0,
        drift_ppm=config.drift_ppm or 0.0,
        source="stated" if config.offset_s else "common",
    )


def _clock_of(
    config: CameraConfig, spec: CaptureConfig, estimate: ClockEstimate, base_s: float
) -> ClockRelation:
    """Return the clock of a camera without regard to shared triggers."""
    estimated = _estimated_clock(estimate, base_s)
    drift = estimated
    if config.drift_ppm is not None or spec.clocks == "common":
        drift = ClockRelation(drift_ppm=config.drift_ppm or 0.0)
    if config.offset_s is None:
        return replace(estimated, drift_ppm=drift.drift_ppm, drift_sigma_ppm=drift.drift_sigma_ppm)
    is_common = spec.clocks == "common" and config.offset_s == 0.0
    stated = ClockRelation(
        offset_s=config.offset_s,
        sigma_s=0.0 if is_common else STATED_SIGMA_S,
        drift_ppm=drift.drift_ppm,
        drift_sigma_ppm=drift.drift_sigma_ppm,
        source="common" if is_common else "stated",
    )
    if not estimated.is_known:
        against = estimate.against_stated
        return replace(stated, notes=(against,), is_contradicted=True) if against else stated
    text = describe_contradiction(
        stated.offset_s - base_s,
        estimated.source,
        estimated.offset_s - base_s,
        estimated.sigma_s,
        STATED_SIGMA_S,
    )
    return replace(stated, notes=(text,), is_contradicted=True) if text else stated


def _estimated_clock(estimate: ClockEstimate, base_s: float) -> ClockRelation:
    if estimate.source not in ESTIMATED_SOURCES or estimate.offset_s is None:
        why = "; ".join(estimate.reasons) or "neither the sound nor the motion determines it"
        return ClockRelation(
            drift_sigma_ppm=CRYSTAL_SIGMA_PPM,
            source="none",
            notes=(f"the clock is unknown: {why}; {UNKNOWN_CLOCK_HINT}",),
        )
    correlation = 0.0
    if estimate.covariance is not None and estimate.sigma_s and estimate.drift_sigma_ppm:
        correlation = float(estimate.covariance[0, 1]) / (estimate.sigma_s * estimate.drift_sigma_ppm)
    return ClockRelation(
        offset_s=base_s + estimate.offset_s,
        sigma_s=estimate.sigma_s or 0.0,
        drift_ppm=estimate.drift_ppm,
        drift_sigma_ppm=estimate.drift_sigma_ppm,
        correlation=correlation,
        source=estimate.source,
        notes=estimate.contradictions,
        is_contradicted=estimate.is_contradicted,
    )


def _with_shared_clock(group: dict[str, ClockRelation]) -> dict[str, ClockRelation]:
    """Return the clocks of cameras with one trigger: unstated clocks equal the best known clock."""
    known = [name for name, clock in group.items() if clock.is_known]
    if not known:
        return group
    order = ("common", "stated", *ESTIMATED_SOURCES)
    best = group[min(known, key=lambda name: (order.index(group[name].source), group[name].sigma_s))]
    shared = replace(best, source="common", notes=(), is_contradicted=False)
    return {
        name: clock if clock is best or clock.source in ("common", "stated") else shared
        for name, clock in group.items()
    }
