"""Find camera settings that spoil a capture: stabilisation, digital zoom, a variable frame rate.

Settings are found only if they are stored in the video files or visible in the frame times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.video import open_container
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.formats.gpmf import gopro_settings

_OFF_VALUES = ("", "N", "N/A", "NA", "OFF", "NONE")
"""Values that mean that a setting is switched off."""
_PHONE_KEYS = {
    "com.apple.quicktime.model": "com.apple.quicktime.make",
    "com.android.model": "com.android.manufacturer",
}
"""Metadata key of a phone's maker, by the metadata key of the phone's model."""
_MAX_RATE_RATIO = 1.5
"""Maximum ratio of the 95th to the 5th percentile of the frame steps for a fixed frame rate.

A frame step is the time between successive frames. Jitter alone gives a smaller ratio. Evidence: none.
"""
_DROPPED_STEP_RATIO = 1.75
"""Maximum ratio of a regular frame step to the median frame step.

If enough steps are regular (`_MIN_REGULAR_RATIO`), a longer step is treated as a dropped frame.
"""
_MIN_REGULAR_RATIO = 0.75
"""Minimum fraction of regular frame steps in a video with dropped frames.

If fewer steps are regular, the long steps are treated as a variable frame rate and not as dropped frames.
Evidence: none.
"""


def setting_notes(camera: CaptureCamera) -> list[str]:
    """Return notes on a camera's settings, found in the first chapter's metadata and in the frame times."""
    path = camera.chapters[0]
    return [*_gopro_notes(gopro_settings(path)), *_phone_notes(path), *_rate_notes(camera.times_ns)]


def _gopro_notes(settings: dict[str, str]) -> list[str]:
    notes = []
    mode = settings.get("EISA", "")
    if settings.get("EISE", mode).upper() not in _OFF_VALUES:
        level = f" ({mode})" if mode.upper() not in (*_OFF_VALUES, "Y") else ""
        notes.append(
            f"the camera stabilised the video{level}: the picture moves relative to the lens, so no "
            "calibration fits; film again with HyperSmooth off"
        )
    if settings.get("DZOM", "N").upper() not in _OFF_VALUES:
        notes.append(
            "the video was filmed with digital zoom: film without zoom, or calibrate the camera at the "
            "same zoom"
        )
    return notes


def _phone_notes(path: Path) -> list[str]:
    with open_container(path) as container:
        metadata = dict(container.metadata)
    for model, maker in _PHONE_KEYS.items():
        if metadata.get(model):
            name = " ".join(part for part in (metadata.get(maker, ""), metadata[model]) if part)
            return [
                f"the video was filmed with a phone ({name}), and the camera app of the phone stabilises "
                "the picture and changes the focus; film with an app that can switch off stabilisation "
                "and lock the focus and the zoom"
            ]
    return []


def _rate_notes(times_ns: IntArray) -> list[str]:
    """Return a note if the frame rate varies; otherwise an empty list. Dropped frames are ignored.

    Args:
        times_ns: (N,) times of the frames, nanoseconds.
    """
    steps = np.diff(times_ns)
    if len(steps) < 20:
        return []
    usual = float(np.median(steps))
    single = steps[steps < _DROPPED_STEP_RATIO * usual]
    if len(single) < _MIN_REGULAR_RATIO * len(steps):
        single = steps
    fast, slow = np.percentile(single, [5, 95])
    if slow < _MAX_RATE_RATIO * fast:
        return []
    return [
        f"the frame rate varies between {1e9 / slow:.0f} and {1e9 / fast:.0f} frames per second, and the "
        "exposure time varies with the frame rate; set a fixed frame rate (on a phone, switch off the "
        "automatic frame rate)"
    ]
