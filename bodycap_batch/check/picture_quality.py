"""Inspect a few frames of a camera for pictures that are hard to track.

Such pictures are black, dark or static, or they have low contrast or too few corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.images import Image
from bodycap_batch.capture.video import COPY_AGAIN, spherical_error
from bodycap_batch.check.spherical_pictures import is_sphere, sphere_differences
from bodycap_batch.check.static_pictures import has_one_view, reduced_picture, static_part
from bodycap_batch.core.arrays import FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.errors import CaptureError

_SAMPLES = 8
"""Number of evenly spaced frames to inspect. Evidence: none."""
_CONFIRMING_SAMPLES = 64
"""Number of evenly spaced frames that confirm that a camera stands still. A short movement of a person who
stands for most of the time is then visible. Evidence: none."""
_MAX_BLACK_GREY = 20.0
"""Maximum grey level (of 255) of a black picture, at the 99th percentile of the pixels.

The sensor noise of a camera with a covered lens stays below this level. Evidence: none.
"""
_MIN_CONTRAST = 12.0
"""Minimum difference (grey levels) between the 99th and the 1st percentile of the pixels.

The difference is smaller if the camera shows a wall out of focus, or if the lens is fogged. Evidence: none.
"""
_MAX_DECODED_FRAMES, _REFERENCE_PIXELS = 250, 640 * 480
"""Maximum number of frames that are decoded after a key frame, for pictures of this size (pixels).

For larger pictures the maximum is smaller in proportion: 9 frames for 4K video. The maximum applies to the
frames that are decoded to reach the end of the video. It applies a second time, as a total, to the frames
that are decoded between rare key frames. Decoding this number of frames takes about a second. Evidence: none.
"""
_MIN_MEDIAN_GREY = 45.0
"""Minimum median grey level (of 255) of pictures that are not dark.

Good captures have a median grey level of 100 or more. Evidence: docs/decisions/check.md.
"""
_FAST_THRESHOLD = 15
"""Minimum contrast (grey levels) of a FAST corner. Evidence: docs/decisions/check.md."""
_MIN_CORNERS = 60
"""Minimum number of FAST corners in a picture of 640 x 480 pixels.

A picture with fewer corners is hard to track. Evidence: docs/decisions/check.md.
"""
_MIN_WIDTH_PX = 160
"""Minimum width (pixels) of a picture whose texture is judged. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureQuality:
    """The result of inspecting a few frames of a camera.

    Attributes:
        notes: Notes about pictures that are hard to track.
        is_static: True if the inspected pictures stand still throughout the recording.
    """

    notes: tuple[str, ...]
    is_static: bool


def stands_still(camera: CaptureCamera) -> bool:
    """Return True if many evenly spaced frames of a camera show the same view.

    Raises:
        CaptureError: A frame cannot be decoded.
    """
    indices = sample_indices(camera, _CONFIRMING_SAMPLES)
    return has_one_view(reduced_picture(image) for _, image in camera.read(indices))


def check_picture_quality(camera: CaptureCamera) -> PictureQuality:
    """Decode a few evenly spaced frames of a camera and inspect them.

    Raises:
        CaptureError: No inspected frame can be decoded, the video has fewer than two frames, or all inspected
            frames are black.
    """
    if sum(len(video.pts) for video in camera.videos) < 2:
        raise CaptureError(
            f"the video of camera {camera.name} contains only one frame, so it shows no movement",
            path=camera.chapters[0],
            hint=f"copy the video again, or leave camera {camera.name} out",
        )
    indices: list[int] = []
    reduced_pictures: list[FloatArray] = []
    edges: list[FloatArray] = []
    corner_counts: list[float] = []
    greys: list[FloatArray] = []
    width, height = camera.videos[0].shown_size
    for index, image in camera.read_decodable(sample_indices(camera, _SAMPLES)):
        indices.append(index)
        reduced_pictures.append(reduced_picture(image))
        corner_counts.append(_corner_count(image))
        greys.append(np.percentile(image, (1, 50, 99)))
        if width == 2 * height:
            edges.append(sphere_differences(image))
    if not indices:
        raise CaptureError(
            f"none of the inspected frames of camera {camera.name} can be decoded",
            path=camera.chapters[0],
            hint=COPY_AGAIN,
        )
    if edges and is_sphere(edges):
        raise spherical_error(
            camera.chapters[0], "equirectangular, because the left edge continues the right edge"
        )
    dark, median, bright = np.array(greys).T
    black = int(np.sum(bright < _MAX_BLACK_GREY))
    if black == len(bright):
        raise CaptureError(
            f"camera {camera.name} shows only black pictures ({black} of {black} inspected)",
            path=camera.chapters[0],
            hint="if the lens was covered, leave this camera out; if a video player shows other pictures, "
            "convert the video to H.264",
        )
    times_s = camera.common_times_ns() / 1e9
    static, static_notes = static_part(
        reduced_pictures, times_s[indices], length_s=float(times_s[-1] - times_s[0])
    )
    few_corners = sum(count < _MIN_CORNERS for count in corner_counts)
    lit = median[median >= _MAX_BLACK_GREY]
    grey = float(np.median(lit)) if len(lit) else np.inf
    findings = (
        (
            any(video.is_interlaced for video in camera.videos),
            "the video is interlaced: convert it to full frames first "
            "(ffmpeg -i in -vf bwdif=send_frame out.mp4)",
        ),
        *((True, note) for note in static_notes),
        (
            black > 0,
            f"{black} of {len(bright)} inspected pictures are black; exclude the black part of the video "
            "with start_s and end_s",
        ),
        (
            grey < _MIN_MEDIAN_GREY,
            f"the pictures are dark (median grey value {grey:.0f} of 255), so the exposure is "
            "long and movement blurs the picture: film with more light, which helps more than any camera "
            "setting",
        ),
        (
            few_corners > 1 and 2 * few_corners >= len(corner_counts),
            f"{few_corners} of {len(corner_counts)} inspected pictures show hardly any texture (plain walls, "
            "a ceiling, or blur): turn the camera towards furniture, or hang up posters",
        ),
        (
            float(np.median(bright - dark)) < _MIN_CONTRAST,
            "the pictures have hardly any contrast, so few features can be tracked: use more light, and "
            "clean the lens",
        ),
    )
    return PictureQuality(notes=tuple(note for is_found, note in findings if is_found), is_static=static)


def _corner_count(image: Image) -> float:
    """Return the number of corners in a picture, scaled to a picture of 640 x 480 pixels.

    The number is infinite for a picture that is too small to judge its texture.
    """
    if image.shape[1] < _MIN_WIDTH_PX:
        return np.inf
    import cv2

    detector = cv2.FastFeatureDetector.create(threshold=_FAST_THRESHOLD)
    return len(detector.detect(image)) * 640.0 * 480.0 / image.size


def sample_indices(camera: CaptureCamera, count: int) -> IntArray:
    """Return the indices of sample frames that are about evenly spaced and cheap to decode.

    The first frame is included. The last frame is included if it is cheap to decode. Otherwise the last frame
    that is cheap to decode is included. Key frames of the codec are preferred, because they decode without
    their neighbours. If key frames are too rare, frames between key frames are used. Decoding the frames
    between key frames takes about a second.

    Args:
        camera: The camera with its videos.
        count: Number of evenly spaced sample frames. The result can contain fewer or more frames.

    Returns:
        (M,) indices of the sample frames, increasing.
    """
    last = len(camera.frame_numbers) - 1
    even = evenly_spaced(last + 1, count)
    keys = camera.key_indices()
    if not len(keys):
        return even[:1]
    picked = keys[np.abs(keys[None] - even[:, None]).argmin(axis=1)]
    # Damage to a recording is visible at its end. If no key frame is near the end, decoding the last frame
    # takes too long, so an earlier frame is used.
    width, height = camera.videos[-1].stored_size
    max_decoded = round(_MAX_DECODED_FRAMES * min(1.0, _REFERENCE_PIXELS / (width * height)))
    end = min(last, int(keys[-1]) + max_decoded)
    far = even[2 * np.abs(picked - even) * max(1, len(even) - 1) > last]
    return np.unique(np.concatenate([picked, _frames_between_keys(far, keys, last, max_decoded), [0, end]]))


def _frames_between_keys(far_indices: IntArray, keys: IntArray, last: int, max_decoded: int) -> IntArray:
    """Return the indices of frames between key frames. They replace sample frames far from a key frame.

    Args:
        far_indices: (N,) indices of the sample frames to replace.
        keys: (K,) indices of the key frames.
        last: Index of the last frame.
        max_decoded: Maximum number of frames that may be decoded for all replacements together.
    """
    before = np.searchsorted(keys, far_indices, side="right") - 1
    starts, counts = np.unique(before[before >= 0], return_counts=True)
    out = [np.zeros(0, dtype=np.int64)]
    for start, frames in zip(starts.tolist(), counts.tolist(), strict=True):
        behind = int(keys[start + 1]) - 1 if start + 1 < len(keys) else last
        reach = min(behind - int(keys[start]), max_decoded // len(starts))
        out.append(keys[start] + np.linspace(0, reach, frames + 1).round().astype(np.int64)[1:])
    return np.concatenate(out)
