"""Decide which clock each camera of a capture has: stated, shared, estimated or unknown."""

from __future__ import annotations

from dataclasses import replace

from bodycap_batch.clocks.estimate import STATED_SIGMA_S, ClockEstimate, ClockEstimates, triggered_groups
from bodycap_batch.clocks.joint_offsets import CRYSTAL_SIGMA_PPM
from bodycap_batch.clocks.reasons import UNKNOWN_CLOCK_HINT, describe_contradiction
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES, CaptureClocks, ClockRelation


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
    if config.drift_ppm is not None or spec.clocks == "common":
        estimated = replace(estimated, drift_ppm=config.drift_ppm or 0.0, drift_sigma_ppm=0.0)
    if config.offset_s is None:
        return estimated
    is_common = spec.clocks == "common" and config.offset_s == 0.0
    against = estimate.against_stated
    if estimated.is_known:
        against = describe_contradiction(
            config.offset_s - base_s,
            estimated.source,
            estimated.offset_s - base_s,
            estimated.sigma_s,
            STATED_SIGMA_S,
        )
    return ClockRelation(
        offset_s=config.offset_s,
        sigma_s=0.0 if is_common else STATED_SIGMA_S,
        drift_ppm=estimated.drift_ppm,
        drift_sigma_ppm=estimated.drift_sigma_ppm,
        source="common" if is_common else "stated",
        notes=(against,) if against else (),
        is_contradicted=bool(against),
    )


def _estimated_clock(estimate: ClockEstimate, base_s: float) -> ClockRelation:
    if estimate.source not in ESTIMATED_SOURCES:
        why = "; ".join(estimate.reasons) or "neither the sound nor the motion determines it"
        return ClockRelation(
            drift_sigma_ppm=CRYSTAL_SIGMA_PPM,
            source="none",
            notes=(f"the clock is unknown: {why}; {UNKNOWN_CLOCK_HINT}",),
        )
    return replace(ClockRelation(**estimate.values()), offset_s=base_s + estimate.offset_s)


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
