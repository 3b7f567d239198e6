"""Compare the rate at which a camera took the pictures with the rate at which the file plays them.

A camera in slow motion takes 120 pictures a second and writes a file that plays 30 of them a second. Some
cameras write the first rate into the metadata.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from bodycap_batch.capture.video import VideoFile
from bodycap_batch.formats.file_completeness import first_box

_XML_RATE = re.compile(rb'captureFps="(\d+(\.\d+)?)p?"')
"""The same rate in the XML text that Sony's cameras write into a box ``meta`` of the file. A value that ends
in i counts half pictures."""
_KEY = re.compile(r"(capture|sensor|shooting)[\W_]*(fps|frame[\W_]*rate)", re.IGNORECASE)
"""Metadata keys of the rate at which the pictures were taken. Android writes ``com.android.capture.fps``;
other cameras use such words, too."""
_NUMBER = re.compile(r"\d+(\.\d+)?")
_MAX_FPS = 100_000.0
"""Maximum plausible rate, frames per second."""
_PLAYED_FPS, _MIN_PLAYED_FPS = 30.0, 23.0
"""Rate at which files with slow motion are played, and minimum such rate, frames per second. A file with
fewer frames per second lacks frames: an encoder for slow motion leaves gaps in the times if the sensor
delivers fewer pictures than it should, as in dim light, and it is set to 30 frames per second. Origin:
Android's encoder, which shortens the time between pictures by the ratio of both rates."""
_MIN_RATIO = 1.8
"""Minimum ratio of the rates that is not a normal recording. Origin: slow motion has at least 2, and cameras
take fewer pictures in dim light."""
_MIN_CLEAR_RATIO = 3.0
"""Ratio of the rates from which a file with sound that lasts as long as the pictures is slow motion. Below,
it may be a camera that takes fewer pictures in dim light. Origin: 60 becomes 30, but 120 does not."""
_SOUND_TOLERANCE, _MIN_SOUND_ERROR_S = 0.1, 1.0
"""Maximum difference of the durations of sound and pictures that last equally long, as a fraction and in
seconds. The larger limit is used. Evidence: none."""


def capture_fps(metadata: Mapping[str, str], path: Path) -> float | None:
    """Return the rate at which the pictures of a file were taken, frames per second; None if it is unknown.

    Args:
        metadata: The metadata of the container.
        path: Path of the file.
    """
    texts = [text.strip() for key, text in metadata.items() if _KEY.search(key)]
    texts += [found.group(1).decode() for found in _XML_RATE.finditer(first_box(path, b"meta"))]
    rates = [float(found.group()) for text in texts if (found := _NUMBER.match(text))]
    return next((rate for rate in rates if 0.0 < rate < _MAX_FPS), None)


def slow_motion(video: VideoFile) -> tuple[float, str]:
    """Return how many times slower the file plays than the camera filmed, and a note for the user.

    The ratio is below 1 for a time lapse, and 1 for a normal recording. The note is empty then, unless the
    rates or the durations of sound and pictures contradict each other.
    """
    name, duration_s = video.path.name, video.duration_ns * 1e-9
    error_s = max(_SOUND_TOLERANCE * duration_s, _MIN_SOUND_ERROR_S)
    has_sound = video.sound_s > 0.0 and abs(video.sound_s - duration_s) < error_s
    played = video.fps if video.fps >= _MIN_PLAYED_FPS else _PLAYED_FPS
    ratio = (video.capture_fps or played) / played
    if 1.0 / _MIN_RATIO < ratio < _MIN_RATIO:
        if has_sound or not video.sound_s or video.restarts:
            return 1.0, ""
        return 1.0, (
            f"{name}: the pictures last {duration_s:.2f} s, and the sound {video.sound_s:.2f} s. If the "
            "frame rate of the file is wrong, write the times into a file of timestamps"
        )
    rates = (
        f"{name}: the camera took {video.capture_fps:g} pictures per second, and the file plays {played:g}"
    )
    if has_sound and 1.0 / _MIN_CLEAR_RATIO < ratio < _MIN_CLEAR_RATIO:
        return 1.0, (
            f"{rates}. Because it has sound, its times are used as they are. If it is slow motion, write the "
            "times into a file of timestamps"
        )
    change = f"slow motion: its times are divided by {ratio:.4g}"
    if ratio < 1.0:
        change = f"a time lapse: its times are multiplied by {1.0 / ratio:.4g}"
    return ratio, f"{rates}. This is {change}"
