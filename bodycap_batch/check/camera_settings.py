"""Find camera settings that spoil a capture: stabilisation, digital zoom, a variable frame rate.

Settings are found only if they are stored in the video files or visible in the frame times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.lens_choice import video_mode
from bodycap_batch.capture.video import open_container
from bodycap_batch.config.calibration import NOTED_RMS_RATIO, CalibratedWith, Calibration, max_rms_px
from bodycap_batch.config.models import CameraConfig
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.formats.gpmf import gopro_settings, gopro_stabilisation
from bodycap_batch.model.picture_turns import stabilisation_note
from bodycap_batch.telemetry.gopro import gyroflow_original, has_picture_orientations

_OFF_VALUES = ("", "N", "N/A", "NA", "OFF", "NONE")
"""Values that mean that a setting is switched off."""
_PHONE_KEYS = {
    "com.apple.quicktime.model": "com.apple.quicktime.make",
    "com.android.model": "com.android.manufacturer",
}
"""Metadata key of a phone's maker, by the metadata key of the phone's model."""
_MAX_FOCAL_DIFFERENCE = 0.05
"""Maximum relative difference of the focal lengths for the two axes of square pixels. 3,052 of 3,140
published calibrations have less; most of the others are of anamorphic lenses or of stretched modes."""
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


def setting_notes(camera: CaptureCamera, *, stabilised: bool | None = None) -> list[str]:
    """Return notes on a camera's settings, found in the first chapter's metadata and in the frame times.

    Args:
        camera: The camera.
        stabilised: Whether the job states that the camera stabilised the video; None if it does not state it.
    """
    path = camera.chapters[0]
    return [
        *([] if stabilised is False else _stabilisation_notes(path)),
        *_gopro_notes(gopro_settings(path)),
        *_phone_notes(path),
        *_rate_notes(camera.times_ns),
    ]


def calibration_notes(config: CameraConfig, camera: CaptureCamera) -> list[str]:
    """Return notes on a given calibration that contradicts the video, or whose own report is bad.

    Args:
        config: The camera in the job.
        camera: The camera, with the intrinsics of the calibration at the work size.
    """
    calibration = config.calibration
    if not isinstance(calibration, Calibration):
        return []
    size, video = (calibration.width, calibration.height), camera.videos[0]
    made = calibration.calibrated_with or CalibratedWith()
    mode = video_mode(video.path)
    notes = [f"the lens was calibrated with this note: {note}" for note in made.notes]
    if made.rms_px is not None and made.rms_px > NOTED_RMS_RATIO * max_rms_px(size):
        notes.append(
            f"the calibration has a large reprojection error ({made.rms_px:.2f} px): calibrate again"
        )
    if size not in (video.shown_size, video.turned_size):
        notes.append(
            f"the lens was calibrated with pictures of {size[0]}×{size[1]} pixels, and the video shows "
            f"{video.shown_size[0]}×{video.shown_size[1]}: the calibration is scaled, which is right only if "
            "both modes of the camera show the same view"
        )
    for what, stated, shown in (
        ("camera", made.camera, mode.model),
        ("lens mode", made.lens_mode, mode.lens_mode),
    ):
        if stated and shown and _letters(shown) not in _letters(stated):
            notes.append(f"the calibration is of the {what} {stated}, and the video states {shown}")
    ratio = camera.camera.focal_ratio
    if abs(ratio - 1.0) > _MAX_FOCAL_DIFFERENCE:
        notes.append(
            f"in square pixels, the focal lengths of the calibration are {ratio:.2f} to 1 (the pixels of the "
            f"video are {video.pixel_aspect} to 1): one of the two is wrong, or the lens is anamorphic"
        )
    return notes


def _letters(text: str) -> str:
    return "".join(letter for letter in text.lower() if letter.isalnum())


def _stabilisation_notes(path: Path) -> list[str]:
    original = gyroflow_original(path)
    if original is not None:
        named = f" ({original})" if original else ""
        return [
            f"the program Gyroflow stabilised this video: use the camera's original file{named} instead, "
            "because Gyroflow turns and zooms the pictures without a record"
        ]
    mode = gopro_stabilisation(gopro_settings(path))
    if mode in {"", "off"}:
        return []
    return [stabilisation_note(mode, recorded=has_picture_orientations(path))]


def _gopro_notes(settings: dict[str, str]) -> list[str]:
    if settings.get("DZOM", "N").upper() in _OFF_VALUES:
        return []
    return [
        "the video was filmed with digital zoom: film without zoom, or calibrate the camera at the same zoom"
    ]


def _phone_notes(path: Path) -> list[str]:
    with open_container(path) as container:
        metadata = dict(container.metadata)
    for model, maker in _PHONE_KEYS.items():
        if metadata.get(model):
            name = " ".join(part for part in (metadata.get(maker, ""), metadata[model]) if part)
            return [
                f"the video was filmed with a phone ({name}), and the camera app of the phone stabilises "
                "the picture and changes the focus; film with an app that can switch off stabilisation "
                "and lock the focus and the zoom. If it was on, state `stabilised: true` for this camera"
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
