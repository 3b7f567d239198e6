"""Describe the clocks of a capture for the user."""

from __future__ import annotations

from bodycap_batch.clocks.capture_clocks import decide_clocks, with_known_offsets
from bodycap_batch.clocks.estimate import estimate_clocks
from bodycap_batch.clocks.reasons import UNKNOWN_CLOCK_HINT
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.model.camera_clock import CaptureClocks, ClockRelation


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


def describe_clocks(spec: CaptureConfig, *, with_body: bool) -> list[str]:
    """Return a sentence for the user about the clock of each camera, and what may be missing without it.

    The clocks are those that are stated, or that the sound determines.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        with_body: True if the job asks for the motion of the body.

    Raises:
        CaptureError: A video or its timestamps cannot be used.
    """
    if len(spec.cameras) < 2:
        return []
    estimates = estimate_clocks(spec)
    clocks = decide_clocks(spec, estimates)
    base_s = clocks.cameras[clocks.reference].offset_s
    lines = []
    for name, clock in clocks.cameras.items():
        if name == clocks.reference:
            text = "reference clock"
        elif clock.is_known:
            text = f"clock offset {_clock_text(clock, base_s)}"
        else:
            reasons = "; ".join(estimates.camera(name).reasons)
            text = f"the sound does not give the clock offset ({reasons})"
        lines.append("; ".join([f"{name}: {text}", *(clock.notes if clock.is_known else ())]))
    return [*lines, *clocks_from_motion_notes(with_known_offsets(spec, clocks), with_body=with_body)]


def _clock_text(clock: ClockRelation, reference_offset_s: float) -> str:
    """Return a known clock as text for the user, relative to the reference camera's clock (seconds)."""
    text = f"{clock.offset_s - reference_offset_s:+.4f}"
    if clock.sigma_s:
        text += f" ± {clock.sigma_s:.4f}"
    text += " s"
    if clock.drift_ppm:
        text += f", {clock.drift_ppm:+.1f} ± {clock.drift_sigma_ppm:.1f} ppm"
    return f"{text} ({clock.source})"
