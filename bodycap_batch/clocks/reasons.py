"""Say for the user why the sound gives no clock, and what contradicts a clock."""

from __future__ import annotations

from collections.abc import Iterator

from bodycap_batch.clocks.container_times import DAY_S, ExpectedOffset
from bodycap_batch.clocks.joint_offsets import MAX_SIGMAS, JointClocks, connected_cameras
from bodycap_batch.clocks.sound_evidence import Recording, SoundEvidence
from bodycap_batch.model.camera_clock import ClockSource

UNKNOWN_CLOCK_HINT = "clap once, or hop once, while all cameras record, or state offset_s"
"""What a user can do about an unknown clock."""
_TURNED_TOLERANCE_S = 0.05
"""Maximum difference, seconds, of a stated offset with the sign turned from that of the sound. Origin: a clap
is found to a frame or so in each video."""


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
    allowed_s = max(MAX_SIGMAS * sigma_s, tolerance_s)
    if abs(stated_s - found_s) <= allowed_s:
        return ""
    text = f"offset_s is stated as {stated_s:.4f} s, but the {source} gives {found_s:.4f} ± {sigma_s:.4f} s"
    turned = abs(stated_s + found_s)
    if turned <= max(allowed_s, _TURNED_TOLERANCE_S) < abs(stated_s - found_s):
        text += f"; with the sign turned the {source} agrees"
    return text


def contradictions_of_sound(
    name: str, evidence: SoundEvidence, joint: JointClocks, stated_s: float | None
) -> Iterator[str]:
    """Yield what contradicts the clock that the sound gives for a camera other than the reference camera.

    Args:
        name: Name of the camera.
        evidence: What the sound says.
        joint: The clocks that were solved from it.
        stated_s: Stated offset of the camera relative to the reference camera, seconds; None without one.
    """
    clock = joint.clocks.get(name)
    if clock is None:
        return
    if stated_s is not None:
        text = describe_contradiction(stated_s, "sound", clock.offset_s, clock.sigma_s)
        yield from [text] if text else []
    for pair in evidence.accepted():
        prior = evidence.expected(pair.first, pair.second)
        if prior is not None and pair.second == name and prior.contradicts(pair.offset_s):
            apart = duration_text(prior.offset_s - pair.offset_s)
            yield (
                f"the files of {pair.first} and {pair.second} give times that are {apart} apart, but their "
                "sound belongs together: the clock of one camera was not set"
            )


def dropped_pairs(name: str, joint: JointClocks) -> Iterator[str]:
    """Yield which pairs of a camera contradict the other pairs."""
    for pair, residual_s in joint.dropped:
        if name in (pair.first, pair.second):
            yield (
                f"the sound of {pair.first} and {pair.second} contradicts that of the other pairs by "
                f"{1e3 * residual_s:+.1f} ms; it is not used"
            )


def reasons_without_clock(name: str, reference: str, evidence: SoundEvidence) -> Iterator[str]:
    """Yield why the sound gives no clock for a camera."""
    recordings = evidence.by_camera()
    if own := recordings[name].problem:
        yield own
        return
    if problem := recordings[reference].problem:
        yield f"{reference}, the reference camera: {problem}"
    connected = connected_cameras(reference, evidence.accepted())
    for pair in evidence.pairs:
        other = {pair.first: pair.second, pair.second: pair.first}.get(name)
        if other is None or other not in connected or pair.accepted:
            continue
        yield f"with {other}: {pair.reason}"
        prior = evidence.expected(pair.first, pair.second)
        if prior is None:
            continue
        if prior.are_dates_apart():
            yield f"according to the files, {other} was recorded {duration_text(prior.offset_s)} apart"
        elif (gap_s := _gap_s(prior, recordings[pair.first], recordings[pair.second])) > 0.0:
            yield (
                f"according to the files, the recordings of {name} and {other} do not overlap: there are "
                f"{duration_text(gap_s)} between them"
            )


def _gap_s(expected: ExpectedOffset, first: Recording, second: Recording) -> float:
    """Return the time between two recordings according to their files, seconds; 0 if they may overlap."""
    low_s, high_s = expected.limits()
    if second.start.first_frame_s + low_s > first.end_s:
        return second.start.first_frame_s + expected.offset_s - first.end_s
    if first.start.first_frame_s > second.end_s + high_s:
        return first.start.first_frame_s - second.end_s - expected.offset_s
    return 0.0


def duration_text(seconds: float) -> str:
    """Return a duration as text: days, hours or seconds."""
    size = abs(seconds)
    if size >= DAY_S:
        return f"{size / DAY_S:.1f} days"
    return f"{size / 3600:.1f} hours" if size >= 3600.0 else f"{size:.1f} s"
