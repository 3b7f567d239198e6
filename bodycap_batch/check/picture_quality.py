"""Look at a few frames of a camera: is there anything to see?"""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.images import Image
from bodycap_batch.check.static_pictures import block_means, static_notes
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError

_SAMPLES = 8
# Sensor noise of a covered lens stays below this grey value (of 255) in 99 of 100 pixels.
_MAX_BLACK_GREY = 20.0
# A wall out of focus, fog on the lens: fewer grey levels than this between dark and bright.
_MIN_CONTRAST = 12.0
# Decoding this many frames for one sample takes a second or two.
_MAX_DECODED_FRAMES, _REFERENCE_PIXELS = 250, 640 * 480
"""So many frames of that size are decoded to see the last one, and as many where key frames are rare: a
second of work each. Of 4K no more than nine."""
# Sound captures have a median grey of 100 and more.
_MIN_MEDIAN_GREY = 45.0
# FAST corners that stand out by this much: 229 and more in every picture looked at of four captures that
# track well, 6 to 70 in most of the palms' that lose a third of their frames.
_FAST_THRESHOLD = 15
_MIN_CORNERS = 60
_MIN_WIDTH_PX = 160


def check_picture_quality(camera: CaptureCamera) -> list[str]:
    """Decode a few evenly spread frames.

    Returns:
        Notes about pictures that make a hard job.

    Raises:
        CaptureError: A frame cannot be decoded, there is only one, or all are black.
    """
    if sum(len(video.pts) for video in camera.videos) < 2:
        raise CaptureError(
            f"camera {camera.name} has a single frame: a picture, no video",
            path=camera.chapters[0],
            hint="copy the video again, or leave the camera out",
        )
    dark, bright = [], []
    grey, corners = [], []
    seen, outlines = [], []
    for index, image in camera.read(sample_indices(camera, _SAMPLES)):
        low, high = np.percentile(image, (1, 99))
        dark.append(float(low))
        bright.append(float(high))
        seen.append(index)
        outlines.append(block_means(image))
        grey.append(float(np.median(image)))
        corners.append(_corner_count(image))
    black = int(np.sum(np.array(bright) < _MAX_BLACK_GREY))
    if black == len(bright):
        raise CaptureError(
            f"camera {camera.name} shows black pictures only ({black} of {black} looked at)",
            path=camera.chapters[0],
            hint="was the lens covered? Leave the camera out; if a player shows it, convert it to H.264",
        )
    notes = []
    if any(video.is_interlaced for video in camera.videos):
        notes.append(
            "interlaced: make whole pictures of it first (ffmpeg -i in -vf bwdif=send_frame out.mp4)"
        )
    times_s = camera.common_times_ns() / 1e9
    notes += static_notes(outlines, times_s[seen], float(times_s[-1] - times_s[0]))
    if black:
        notes.append(
            f"{black} of {len(bright)} pictures looked at are black; cut them off with start_s and end_s"
        )
    notes += _tracking_notes(grey, corners)
    contrast = np.array(bright) - np.array(dark)
    if float(np.median(contrast)) < _MIN_CONTRAST:
        notes.append("hardly any contrast in the pictures: little will be found to track")
    return notes


def _corner_count(image: Image) -> float:
    """Corners in a picture, as many as there would be at 640 × 480; a thumbnail tells nothing of texture."""
    if image.shape[1] < _MIN_WIDTH_PX:
        return np.inf
    import cv2

    detector = cv2.FastFeatureDetector.create(threshold=_FAST_THRESHOLD)
    return len(detector.detect(image)) * 640.0 * 480.0 / image.size


def _tracking_notes(grey: list[float], corners: list[float]) -> list[str]:
    """What light and texture say; black pictures are told elsewhere."""
    out = []
    lit = [value for value in grey if value >= _MAX_BLACK_GREY]
    if lit and float(np.median(lit)) < _MIN_MEDIAN_GREY:
        out.append(
            f"dark pictures (median grey {np.median(lit):.0f} of 255): the shutter stays open long and "
            "movement blurs; more light helps more than any setting"
        )
    bare = sum(count < _MIN_CORNERS for count in corners)
    if 2 * bare >= len(corners) and bare > 1:
        out.append(
            f"{bare} of {len(corners)} pictures looked at show hardly anything to hold on to (plain walls, "
            "ceiling, or blur): turn the camera to where there is furniture, or hang up posters"
        )
    return out


def sample_indices(camera: CaptureCamera, count: int) -> IntArray:
    """Evenly spread frames: such as decode without their neighbours, the first and, if near one, the last.

    Where those are rarer than the frames wanted, frames between them, as far as can be decoded in a second.
    """
    last = len(camera.frame_numbers) - 1
    even = np.unique(np.linspace(0, last, min(count, last + 1)).round().astype(np.int64))
    keys = camera.key_indices()
    if not len(keys):
        return even[:1]
    picked = keys[np.abs(keys[None] - even[:, None]).argmin(axis=1)]
    # The end is where a broken recording shows; without a key frame near it, it costs too much.
    width, height = camera.videos[-1].stored_size
    stretch = round(_MAX_DECODED_FRAMES * min(1.0, _REFERENCE_PIXELS / (width * height)))
    end = min(last, int(keys[-1]) + stretch)
    far = even[2 * np.abs(picked - even) * max(1, len(even) - 1) > last]
    return np.unique(np.concatenate([picked, _frames_between_keys(far, keys, last, stretch), [0, end]]))


def _frames_between_keys(wanted: IntArray, keys: IntArray, last: int, stretch: int) -> IntArray:
    """Frames in the place of those that no key frame is near; `stretch` of them are decoded for it."""
    before = np.searchsorted(keys, wanted, side="right") - 1
    starts, counts = np.unique(before[before >= 0], return_counts=True)
    out = [np.zeros(0, dtype=np.int64)]
    for start, frames in zip(starts.tolist(), counts.tolist(), strict=True):
        behind = int(keys[start + 1]) - 1 if start + 1 < len(keys) else last
        reach = min(behind - int(keys[start]), stretch // len(starts))
        out.append(keys[start] + np.linspace(0, reach, frames + 1).round().astype(np.int64)[1:])
    return np.concatenate(out)
