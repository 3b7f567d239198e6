"""Add what the motion says about the clocks to what the sound says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodycap_batch.clocks.estimate import ClockEstimate, ClockEstimates
from bodycap_batch.clocks.joint_offsets import CRYSTAL_SIGMA_PPM, MAX_SIGMAS, WAY_SIGMA_S
from bodycap_batch.clocks.motion_offsets import MotionClocks
from bodycap_batch.clocks.pair_offsets import PairOffset
from bodycap_batch.clocks.sound_evidence import Recording, SoundEvidence
from bodycap_batch.model.camera_clock import ClockRelation

_MAX_DIFFERENCE_S = 1.0 / 30.0
"""Difference, seconds, of sound and motion that is no contradiction. Origin: one frame at 30 fps."""
_MIN_SCORE_DROP = 5.0
"""Minimum logarithm of the likelihood of the best offset over that of a stated offset, with which the motion
contradicts the latter. Evidence: docs/decisions/clocks.md."""
_EQUAL_COUNT_PRIOR, _OTHER_PRIOR = 0.5, 0.02
"""Probability that the first frames of two videos show the same instant, before the motion is looked at: if
the videos have the same number of frames, and otherwise. Cameras that were started by hand hardly ever record
the same number of frames. Evidence: none."""
_MIN_POSTERIOR = 0.9
"""Minimum probability with which a common start is accepted. Evidence: none."""
_START_RANGE_S = 20.0
"""Range, seconds, in which the offsets of cameras that were started by hand lie. Evidence: none."""


def add_motion(
    estimates: ClockEstimates,
    motion: MotionClocks,
    evidence: SoundEvidence,
    stated_s: Mapping[str, float] | None = None,
) -> ClockEstimates:
    """Return the clocks from the sound, completed and checked by the motion.

    - A clock that the sound does not determine is taken from the motion.
    - A clock that is related by sound only to cameras with a clock from the motion is taken from both.
    - If the sound is known only as well as the motion (unlike cameras), the mean of both is used.
    - A contradiction between sound and motion is noted, and so is a stated offset that fits the motion much
      worse than another one.

    Args:
        estimates: The clocks that were estimated from the sound.
        motion: The clocks that were estimated from the motion, with the same reference camera.
        evidence: What the sound says, with the numbers of frames of the videos.
        stated_s: Stated offset of each camera relative to the reference camera, seconds, by camera name.
    """
    recordings = evidence.by_camera()
    found = {}
    for estimate in estimates.cameras:
        clock = motion.clocks.get(estimate.camera)
        if estimate.camera == estimates.reference or estimate.source == "common":
            found[estimate.camera] = estimate
        elif estimate.source == "sound":
            found[estimate.camera] = _compared(estimate, clock)
        elif clock is not None:
            reference = recordings.get(estimates.reference)
            found[estimate.camera] = _from_motion(estimate, clock, reference, recordings.get(estimate.camera))
        else:
            reason = motion.reasons.get(estimate.camera, "the motion does not determine the offset")
            found[estimate.camera] = replace(estimate, reasons=(*estimate.reasons, f"motion: {reason}"))
    _complete_from_sound(found, estimates.pairs)
    for name, offset_s in (stated_s or {}).items():
        text = _against_stated(motion, name, offset_s)
        if name in found and text:
            found[name] = replace(found[name], against_stated=text)
    return replace(estimates, cameras=tuple(found[each.camera] for each in estimates.cameras))


def _compared(estimate: ClockEstimate, clock: ClockRelation | None) -> ClockEstimate:
    """Return the clock from the sound, compared with the clock from the motion."""
    if clock is None:
        return estimate
    difference_s = clock.offset_s - estimate.offset_s
    sigma_s = float(np.hypot(clock.sigma_s, estimate.sigma_s))
    if abs(difference_s) > max(MAX_SIGMAS * sigma_s, _MAX_DIFFERENCE_S):
        text = (
            f"the motion gives an offset of {clock.offset_s:.3f} ± {clock.sigma_s:.3f} s, but the "
            f"sound gives {estimate.offset_s:.3f} ± {estimate.sigma_s:.3f} s"
        )
        return replace(estimate, notes=(*estimate.notes, text), is_contradicted=True)
    if estimate.sigma_s < 0.5 * clock.sigma_s:
        return estimate
    weight = estimate.sigma_s**2 / (estimate.sigma_s**2 + clock.sigma_s**2)
    mean_sigma_s = estimate.sigma_s * clock.sigma_s / sigma_s
    return replace(estimate, offset_s=estimate.offset_s + weight * difference_s, sigma_s=mean_sigma_s)


def _against_stated(motion: MotionClocks, camera: str, offset_s: float) -> str:
    """Return how the motion contradicts a stated offset; empty if it does not.

    The test needs no clear peak: it compares the stated offset with the best one.

    Args:
        motion: The clocks that were estimated from the motion.
        camera: Name of the camera.
        offset_s: Stated offset relative to the reference camera, seconds.
    """
    for curve in motion.curves:
        if {curve.first, curve.second} != {motion.reference, camera}:
            continue
        sign = 1.0 if curve.first == motion.reference else -1.0
        lags_s, score = curve.scores.lags_s, curve.scores.score
        if not lags_s[0] <= sign * offset_s <= lags_s[-1]:
            continue
        best = int(np.argmax(score))
        drop = float(score[best] - np.interp(sign * offset_s, lags_s, score))
        if drop >= _MIN_SCORE_DROP:
            return (
                f"the motion contradicts the offset of {offset_s:.3f} s that the job uses: an offset of "
                f"about {sign * lags_s[best]:.1f} s fits much better"
            )
    return ""


def _from_motion(
    estimate: ClockEstimate, clock: ClockRelation, reference: Recording | None, recording: Recording | None
) -> ClockEstimate:
    """Return the clock from the motion, or a common start if that is much more probable."""
    found = replace(estimate, **{**clock.values(), "notes": estimate.notes})
    if reference is None or recording is None or clock.drift_ppm:
        return found
    start_s = reference.start.first_frame_s - recording.start.first_frame_s
    prior = _EQUAL_COUNT_PRIOR if recording.frames == reference.frames else _OTHER_PRIOR
    posterior = _common_start_probability(clock.offset_s - start_s, clock.sigma_s, prior)
    if posterior < _MIN_POSTERIOR:
        return found
    sigma_s = float(np.sqrt(1.0 - posterior) * np.hypot(clock.offset_s - start_s, clock.sigma_s))
    return replace(found, offset_s=start_s, sigma_s=sigma_s)


def _common_start_probability(difference_s: float, sigma_s: float, prior: float) -> float:
    """Return the probability that two videos start at the same instant.

    The alternative is that the difference has any value within `_START_RANGE_S` with the same probability.

    Args:
        difference_s: Offset from the motion minus the offset for a common start, seconds.
        sigma_s: Standard deviation of the offset from the motion, seconds.
        prior: Probability of a common start without the motion.
    """
    density = np.exp(-0.5 * (difference_s / sigma_s) ** 2) / (np.sqrt(2.0 * np.pi) * sigma_s)
    odds = prior / (1.0 - prior) * density * _START_RANGE_S
    return float(odds / (1.0 + odds))


def _complete_from_sound(found: dict[str, ClockEstimate], pairs: tuple[PairOffset, ...]) -> None:
    """Determine unknown clocks from the sound of cameras whose clocks are known from the motion, in place."""
    while True:
        news = {}
        for pair in pairs:
            unknown, known = sorted((found[pair.first], found[pair.second]), key=lambda each: each.is_known)
            if pair.accepted and known.is_known and not unknown.is_known:
                news[unknown.camera] = _through_pair(unknown, known, pair)
        if not news:
            return
        found.update(news)


def _through_pair(unknown: ClockEstimate, known: ClockEstimate, pair: PairOffset) -> ClockEstimate:
    """Return a clock from the clock of another camera and the sound of both.

    Args:
        unknown: The estimate of the camera without a clock.
        known: The clock of the other camera.
        pair: What the sound of both says.
    """
    is_second = unknown.camera == pair.second
    first_s, second_s = pair.pivot_s + pair.offset_s, pair.pivot_s
    own_s, other_s = (second_s, first_s) if is_second else (first_s, second_s)
    drift_ppm = known.drift_ppm + (pair.drift_ppm if is_second else -pair.drift_ppm)
    common_s = other_s * (1.0 + 1e-6 * known.drift_ppm) + known.offset_s
    sigma_s = float(np.linalg.norm([known.sigma_s, pair.sigma_s, WAY_SIGMA_S]))
    drift_sigma_ppm = min(
        float(np.hypot(known.drift_sigma_ppm, pair.drift_sigma_ppm)), float(np.sqrt(2)) * CRYSTAL_SIGMA_PPM
    )
    return replace(
        unknown,
        offset_s=common_s - own_s * (1.0 + 1e-6 * drift_ppm),
        sigma_s=sigma_s,
        drift_ppm=drift_ppm,
        drift_sigma_ppm=drift_sigma_ppm,
        source="motion",
    )
