"""Find frames that repeat the picture before them, and the times at which the pictures were taken.

A conversion from 24 to 30 frames per second shows every fourth picture twice. A recorder that misses a frame
shows the one before again. The camera was elsewhere at the time of such a frame, so it is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs, set_array
from bodycap_batch.model.frozen_frames import MIN_FROZEN_S, MIN_JUMP_PX

_MAX_COPY_RATIO = 0.1
"""Maximum ratio of the change or displacement of a copy to that of the pictures around it. At 30 frames per
second, no movement stops and goes on within one frame. Evidence: docs/decisions/keyframes.md."""
_MAX_ENCODED_RATIO = 0.5
"""The same for the change of a copy that the encoder encoded again, which does not displace its corners.
Evidence: docs/decisions/keyframes.md."""
_MIN_COPIES = 8
"""Minimum number of copies, and of pairs of steps, that show whether a video is a regular conversion.
Evidence: none."""
_MIN_REGULAR = 0.95
"""Minimum share of the copies that a regular conversion explains, and minimum share of the copies it predicts
that do not clearly show another picture. Evidence: docs/decisions/keyframes.md."""
_PADDING, _PHASES = 8, 41
"""Length of the spectrum over the number of frames, and number of phases that are tried. Origin: the error of
the frequency moves the last copy by a sixteenth of a period, before the fit."""
_MIN_STEP_RATIO = 1.25
"""Minimum ratio of two steps that are compared. Evidence: none."""
_MAX_EVEN_SLOPE = 0.5
"""Maximum growth of the logarithm of the movement with the logarithm of the step, of pictures that were taken
at even times. It is 0 for these, and 1 for pictures that were taken at the times of their frames."""
_MAX_RESIDUAL = 0.75
"""Maximum difference of the time of a frame from the even times, in frame intervals. Origin: a conversion
rounds to the nearest frame, or to the next one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pictures:
    """The frames of a video that show a picture of their own, and when these pictures were taken.

    Attributes:
        frames: (M,) indices among the frames of the camera, increasing.
        times_ns: (M,) times of these frames, nanoseconds, increasing.
    """

    frames: IntArray
    times_ns: IntArray

    def __post_init__(self) -> None:
        set_array(self, "frames", (None,), np.int64)
        set_array(self, "times_ns", (len(self.frames),), np.int64)


def find_pictures(change_px: FloatArray, shift_px: FloatArray, times_ns: IntArray) -> Pictures | None:
    """Find the frames of a video that are no copies of the frame before, and when their pictures were taken.

    Args:
        change_px: (N,) change between each frame and the frame before it, px of the reduced image; NaN where
            it is unknown. See `picture_change_px`.
        shift_px: (N,) median displacement of corners between each frame and the frame before it, px of the
            reduced image; NaN where it is unknown.
        times_ns: (N,) times of the frames, nanoseconds.

    Returns:
        The frames and their times; None if there are no copies.
    """
    copied = _copied_frames(change_px, shift_px, (times_ns - times_ns[0]) * 1e-9)
    if not copied.any():
        return None
    return Pictures(frames=np.flatnonzero(~copied), times_ns=_picture_times(times_ns, copied, shift_px))


def _copied_frames(change_px: FloatArray, shift_px: FloatArray, times_s: FloatArray) -> BoolArray:
    """Find the frames that repeat the picture before them while the camera moves.

    A picture of a camera that stands still repeats, too. So the picture must change before and after the
    repetition, and much more than in it. Where slow motion hides this, the copies of a regular conversion
    follow from the others.

    Returns:
        (N,) True for each repetition. The first frame with the picture is not a repetition.
    """
    copied, is_other = np.zeros(len(change_px), dtype=bool), np.zeros(len(change_px), dtype=bool)
    for start, stop in runs((change_px < MIN_JUMP_PX) | (shift_px < MIN_JUMP_PX)):
        ends = [end for end in (start - 1, stop) if 0 < end < len(copied)] or [0]
        change, shift = change_px[start:stop], shift_px[start:stop]
        around, moved = np.nan_to_num(change_px[ends]).min(), np.nan_to_num(shift_px[ends], nan=np.inf).min()
        is_same = change < _MAX_COPY_RATIO * around
        is_same |= (change < _MAX_ENCODED_RATIO * around) & (shift < _MAX_COPY_RATIO * moved)
        is_short = times_s[stop - 1] - times_s[start - 1] < MIN_FROZEN_S
        copied[start:stop] = is_short and min(around, moved) > MIN_JUMP_PX and bool(is_same.all())
    is_other[1:-1] = change_px[1:-1] > np.maximum(MIN_JUMP_PX, _MAX_ENCODED_RATIO * change_px[2:])
    return copied | _regular_copies(copied, is_other)


def _regular_copies(copied: BoolArray, is_other: BoolArray) -> BoolArray:
    """Return the copies (N,) that a conversion with a fixed ratio makes; none if the copies are not regular.

    Args:
        copied: (N,) True for each frame that is certainly a copy.
        is_other: (N,) True for each frame that clearly shows another picture.
    """
    count, found = len(copied), np.flatnonzero(copied)
    best = np.zeros(count, dtype=bool)
    if len(found) < _MIN_COPIES:
        return best
    spectrum = np.abs(np.fft.rfft(copied - copied.mean(), _PADDING * count))
    share = float(np.argmax(spectrum)) / (_PADDING * count)
    share, first = np.polyfit(found, np.round((found - found[len(found) // 2]) * share), 1)
    for phase in np.linspace(-0.5, 0.5, _PHASES):
        # The number of copies grows evenly. A frame is a copy if the number passes a whole number there.
        predicted = np.diff(np.floor(share * np.arange(-1, count) + first + phase)) > 0
        if (predicted & copied).sum() > (best & copied).sum():
            best = predicted
    explained, wrong = (best & copied).sum() / len(found), (best & is_other).sum() / max(best.sum(), 1)
    return best & ~is_other if min(explained, 1.0 - wrong) >= _MIN_REGULAR else np.zeros_like(best)


def _picture_times(times_ns: IntArray, copied: BoolArray, shift_px: FloatArray) -> IntArray:
    """Return the times at which the pictures of a video with repetitions were taken.

    A conversion of the frame rate shows pictures that were taken at even times in the nearest frames. If the
    movement between the pictures is even although their frames are not, even times are fitted to those of the
    frames. Otherwise each picture was taken at the time of its frame: a repetition replaced another picture.

    Args:
        times_ns: (N,) times of the frames, nanoseconds.
        copied: (N,) True for each repetition.
        shift_px: (N,) as in `find_pictures`.

    Returns:
        (M,) times of the frames that are no repetitions, nanoseconds.
    """
    own = times_ns[~copied]
    steps, moved = np.diff(own).astype(np.float64), shift_px[~copied][1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        longer, further = np.log(steps[1:] / steps[:-1]), np.log(moved[1:] / moved[:-1])
    usable = (np.abs(longer) > np.log(_MIN_STEP_RATIO)) & np.isfinite(further)
    if usable.sum() < _MIN_COPIES or np.median(further[usable] / longer[usable]) > _MAX_EVEN_SLOPE:
        return own
    since, number = (own - own[0]).astype(np.float64), np.arange(len(own))
    for _ in range(2):  # the second fit also allows for pictures that are missing
        slope, first = np.polyfit(number, since, 1)
        even, number = slope * number + first, np.round((since - first) / slope)
    frame_ns = float(np.median(np.diff(times_ns)))
    if np.abs(even - since).max() > _MAX_RESIDUAL * frame_ns or (np.diff(number) < 1).any():
        return own
    # Times that are rounded to the nearest frame differ by multiples of a fraction 1/q of the frame interval.
    # With an even q, some lie in the middle and are rounded up: then all are late by half of this fraction.
    fraction = max(1.0 - float(np.ptp(since - even)) / frame_ns, 1e-3)
    even -= 0.5 * fraction * frame_ns * (round(1.0 / fraction) % 2 == 0)
    return np.asarray(own[0] + np.round(even).astype(np.int64))


def copied_notes(times_ns: IntArray, pictures: Pictures | None) -> list[str]:
    """Return a note for the user about the copies in a video; nothing without copies.

    Args:
        times_ns: (N,) times of all frames, nanoseconds.
        pictures: The frames that are no copies.
    """
    if pictures is None:
        return []
    count = len(times_ns) - len(pictures.frames)
    text = (
        f"{count} of {len(times_ns)} frames are copies of the frame before, as a conversion of the frame "
        "rate makes, or a recorder that misses frames: they measure nothing and are left out"
    )
    if (pictures.times_ns != times_ns[pictures.frames]).any():
        fps = 1e9 * (len(pictures.frames) - 1) / float(pictures.times_ns[-1] - pictures.times_ns[0])
        text += f". The other pictures were taken at even times, {fps:.4g} per second, and get these times"
    return [text]
