"""Find the damaged frames of a camera: frames that cannot be decoded, or whose data are damaged."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture.cameras import CaptureCamera
from bodycap_batch.core.arrays import IntArray


def find_damaged_frames(camera: CaptureCamera) -> IntArray:
    """Decode all frames of a camera, and return the indices (D,) of the damaged frames."""
    sound = [index for index, frame, _ in camera.decodable_frames() if not frame.is_corrupt]
    return np.setdiff1d(np.arange(len(camera.frame_numbers)), np.array(sound, dtype=np.int64))


def damage_notes(camera: CaptureCamera, damaged: IntArray) -> list[str]:
    """Return a note for the user about the damaged frames of a camera; nothing if there are none.

    Args:
        camera: The camera.
        damaged: (D,) indices of the damaged frames.
    """
    if len(damaged) == 0:
        return []
    times_s = camera.common_times_ns()[damaged] / 1e9
    return [
        f"{len(damaged)} of {len(camera.frame_numbers)} frames are damaged in the video (the decoder reports "
        f"errors or gives no picture); they are between {times_s[0]:.2f} and {times_s[-1]:.2f} s on the "
        "common clock, and they are left out: to get them, copy the video again from the camera's card"
    ]
