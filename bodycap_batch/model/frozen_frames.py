"""Find frozen frames: frames in which the recording repeats an earlier picture although the camera moves."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.model.optical_flow import GreyImage

_MIN_GRADIENT = 0.5
"""Minimum mean gradient, grey levels per pixel, of a reduced image with texture. With less texture, neither a
repetition nor a movement is visible. Evidence: docs/decisions/keyframes.md."""
_MAX_COPY_CHANGE_PX = 0.2
"""Maximum change between a picture and its repetition, px of the reduced image. The encoder still refines the
picture in the first repetitions. Evidence: docs/decisions/keyframes.md."""
_MAX_MEDIAN_CHANGE_PX = 0.01
"""Maximum median change of the repetitions in a frozen part, px of the reduced image. Evidence:
docs/decisions/keyframes.md."""
_MAX_ENCODER_SHIFT_PX = 0.15
"""Maximum median displacement of corners, px of the reduced image, in a repetition that the encoder encodes
again. Evidence: none."""
MIN_JUMP_PX = 0.3
"""Minimum change next to a frozen part, px of the reduced image. At this limit, the movement stops or starts
within one frame. The picture of a person who stops or starts to move changes gradually. Evidence:
docs/decisions/keyframes.md."""
_MIN_COPIES, MIN_FROZEN_S = 3, 0.2
"""Minimum number of repetitions in a frozen part, and minimum duration (seconds) of the part. Shorter parts
come from a conversion to a constant frame rate: it repeats single frames. Evidence: none."""


def frozen_notes(camera: str, frozen: BoolArray, times_s: FloatArray) -> list[str]:
    """Return a note for the user about each frozen part of a video.

    Args:
        camera: Camera name.
        frozen: (N,) True for each frozen frame.
        times_s: (N,) common times of the frames, seconds.
    """
    return [
        f"{camera}: the recording repeats one picture from {times_s[start]:.2f} to {times_s[stop - 1]:.2f} s "
        f"while the camera moves: these {stop - start} frames are lost (FROZEN)"
        for start, stop in runs(frozen)
    ]


def picture_change_px(before: GreyImage, after: GreyImage) -> float:
    """Return the change between two successive reduced pictures, as a displacement in px.

    The change is the mean difference of the grey levels, divided by the mean gradient. For a small
    displacement of the picture, the result is about this displacement. It does not depend on the contrast.

    Args:
        before: (H,W) grey picture.
        after: (H,W) grey picture of the next frame.

    Returns:
        The change, px; NaN if the pictures have too little texture.
    """
    import cv2

    if before.shape != after.shape or min(after.shape) < 2:
        return float("nan")
    along, down = (cv2.absdiff(after[1:], after[:-1]), cv2.absdiff(after[:, 1:], after[:, :-1]))
    gradient = 0.5 * (cv2.mean(along)[0] + cv2.mean(down)[0])
    if gradient < _MIN_GRADIENT:
        return float("nan")
    return float(cv2.mean(cv2.absdiff(before, after))[0] / gradient)


def find_frozen_frames(change_px: FloatArray, shift_px: FloatArray, times_s: FloatArray) -> BoolArray:
    """Find the frames that repeat an earlier picture although the camera moves.

    Such a frame has no information about the pose of the camera at its time. Three conditions distinguish it
    from a picture of a camera that stands still. First, most pictures are almost bit-wise copies. Second, the
    movement stops or starts within one frame. Third, the part is longer than a repetition by a conversion of
    the frame rate.

    Args:
        change_px: (N,) change between each frame and the frame before it, px of the reduced image; NaN where
            it is unknown. See `picture_change_px`.
        shift_px: (N,) median displacement of corners between each frame and the frame before it, px of the
            reduced image; NaN where it is unknown. An encoder sometimes encodes the whole picture again. The
            repeated picture then changes, but its corners stay in place.
        times_s: (N,) times of the frames, seconds.

    Returns:
        (N,) True for each repetition. The first frame with the picture is not a repetition.
    """
    count = len(change_px)
    frozen = np.zeros(count, dtype=bool)
    is_copy = np.zeros(count + 1, dtype=bool)
    is_copy[:count] = change_px < _MAX_COPY_CHANGE_PX
    again = ~is_copy[:-1] & (shift_px < _MAX_ENCODER_SHIFT_PX)
    again[1:] &= is_copy[:-2]
    again[:-1] &= is_copy[1:-1]
    jump_px = np.concatenate([change_px, [np.nan]])
    for start, stop in runs(is_copy[:-1] | again):
        if start == 0:
            continue
        has_jump = jump_px[start - 1] > MIN_JUMP_PX or jump_px[stop] > MIN_JUMP_PX
        is_long = stop - start >= _MIN_COPIES and times_s[stop - 1] - times_s[start - 1] >= MIN_FROZEN_S
        if has_jump and is_long and np.median(change_px[start:stop]) < _MAX_MEDIAN_CHANGE_PX:
            frozen[start:stop] = True
    return frozen
