"""Inspect a few frames of a camera: black, dark, static or low-contrast pictures, and too few corners."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.images import Image
from bodycap_batch.check.static_pictures import reduced_picture, static_notes
from bodycap_batch.core.arrays import IntArray, evenly_spaced
from bodycap_batch.core.errors import CaptureError

_SAMPLES = 8
"""Number of frames to inspect. Evidence: none."""
_MAX_BLACK_GREY = 20.0
"""Grey level (of 255). The sensor noise of a covered lens stays below it in 99 of 100 pixels. Evidence:
none."""
_MIN_CONTRAST = 12.0
"""Grey levels between the 1st and the 99th percentile. A wall out of focus or a fogged lens has fewer.
Evidence: none."""
_MAX_DECODED_FRAMES, _REFERENCE_PIXELS = 250, 640 * 480
"""Frames of that many pixels that may be decoded to reach the last frame, and as many to reach frames between
rare key frames. Each takes about a second; for 4K video the limit is 9 frames. Evidence: none."""
_MIN_MEDIAN_GREY = 45.0
"""Median grey level below which pictures are dark; good captures have 100 and more. Evidence:
docs/decisions/check.md."""
_FAST_THRESHOLD = 15
"""Contrast of a FAST corner in grey levels. Evidence: docs/decisions/check.md."""
_MIN_CORNERS = 60
"""FAST corners of a picture of 640 x 480 pixels, below which tracking is hard. Evidence:
docs/decisions/check.md."""
_MIN_WIDTH_PX = 160
"""Pictures narrower than this are too small to judge their texture, pixels. Evidence: none."""


def check_picture_quality(camera: CaptureCamera) -> list[str]:
    """Decode a few evenly spaced frames and inspect them.

    Returns:
        Notes about pictures that are hard to track.

    Raises:
        CaptureError: A frame cannot be decoded, there is only one, or all are black.
    """
    if sum(len(video.pts) for video in camera.videos) < 2:
        raise CaptureError(
            f"camera {camera.name} has a single frame: it is a picture, not a video",
            path=camera.chapters[0],
            hint="copy the video again, or leave the camera out",
        )
    dark, bright = [], []
    grey, corners = [], []
    indices, reduced_pictures = [], []
    for index, image in camera.read(sample_indices(camera, _SAMPLES)):
        low, high = np.percentile(image, (1, 99))
        dark.append(float(low))
        bright.append(float(high))
        indices.append(index)
        reduced_pictures.append(reduced_picture(image))
        grey.append(float(np.median(image)))
        corners.append(_corner_count(image))
    black = int(np.sum(np.array(bright) < _MAX_BLACK_GREY))
    if black == len(bright):
        raise CaptureError(
            f"camera {camera.name} shows only black pictures ({black} of {black} inspected)",
            path=camera.chapters[0],
            hint="was the lens covered? Leave the camera out; if a player shows it, convert it to H.264",
        )
    notes = []
    if any(video.is_interlaced for video in camera.videos):
        notes.append(
            "interlaced: convert it to full frames first (ffmpeg -i in -vf bwdif=send_frame out.mp4)"
        )
    times_s = camera.common_times_ns() / 1e9
    notes += static_notes(reduced_pictures, times_s[indices], float(times_s[-1] - times_s[0]))
    if black:
        notes.append(
            f"{black} of {len(bright)} inspected pictures are black; cut them off with start_s and end_s"
        )
    notes += _tracking_notes(grey, corners)
    contrast = np.array(bright) - np.array(dark)
    if float(np.median(contrast)) < _MIN_CONTRAST:
        notes.append("the pictures have hardly any contrast: few features can be tracked")
    return notes


def _corner_count(image: Image) -> float:
    """Return the number of corners, scaled to a picture of 640 x 480 pixels; infinite for a thumbnail."""
    if image.shape[1] < _MIN_WIDTH_PX:
        return np.inf
    import cv2

    detector = cv2.FastFeatureDetector.create(threshold=_FAST_THRESHOLD)
    return len(detector.detect(image)) * 640.0 * 480.0 / image.size


def _tracking_notes(grey: list[float], corners: list[float]) -> list[str]:
    """Return notes on low light and missing texture. Black pictures are reported separately.

    Args:
        grey: Median grey level of each picture.
        corners: Corners of each picture.
    """
    out = []
    lit = [value for value in grey if value >= _MAX_BLACK_GREY]
    if lit and float(np.median(lit)) < _MIN_MEDIAN_GREY:
        out.append(
            f"dark pictures (median grey {np.median(lit):.0f} of 255): the shutter stays open long and "
            "movement blurs; more light helps more than any setting"
        )
    few_corners = sum(count < _MIN_CORNERS for count in corners)
    if 2 * few_corners >= len(corners) and few_corners > 1:
        out.append(
            f"{few_corners} of {len(corners)} inspected pictures show hardly any texture (plain walls, "
            "ceiling, or blur): turn the camera towards furniture, or hang up posters"
        )
    return out


def sample_indices(camera: CaptureCamera, count: int) -> IntArray:
    """Return indices of evenly spaced frames, with the first frame and, if it is cheap to decode, the last.

    Key frames are preferred, because they decode without their neighbours. If they are too rare, frames
    between them are used, as far as they can be decoded in a second.

    Args:
        camera: The camera.
        count: Number of frames wanted.
    """
    last = len(camera.frame_numbers) - 1
    even = evenly_spaced(last + 1, count)
    keys = camera.key_indices()
    if not len(keys):
        return even[:1]
    picked = keys[np.abs(keys[None] - even[:, None]).argmin(axis=1)]
    # A broken recording shows at its end. Without a key frame near the end, decoding it takes too long.
    width, height = camera.videos[-1].stored_size
    max_decoded = round(_MAX_DECODED_FRAMES * min(1.0, _REFERENCE_PIXELS / (width * height)))
    end = min(last, int(keys[-1]) + max_decoded)
    far = even[2 * np.abs(picked - even) * max(1, len(even) - 1) > last]
    return np.unique(np.concatenate([picked, _frames_between_keys(far, keys, last, max_decoded), [0, end]]))


def _frames_between_keys(far_indices: IntArray, keys: IntArray, last: int, max_decoded: int) -> IntArray:
    """Return frames to replace sample frames that are far from a key frame.

    Args:
        far_indices: (N,) indices of the frames to replace.
        keys: (K,) indices of the key frames.
        last: Index of the last frame.
        max_decoded: Number of frames that may be decoded in all.
    """
    before = np.searchsorted(keys, far_indices, side="right") - 1
    starts, counts = np.unique(before[before >= 0], return_counts=True)
    out = [np.zeros(0, dtype=np.int64)]
    for start, frames in zip(starts.tolist(), counts.tolist(), strict=True):
        behind = int(keys[start + 1]) - 1 if start + 1 < len(keys) else last
        reach = min(behind - int(keys[start]), max_decoded // len(starts))
        out.append(keys[start] + np.linspace(0, reach, frames + 1).round().astype(np.int64)[1:])
    return np.concatenate(out)
