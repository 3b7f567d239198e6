"""Find the damaged frames of a camera: frames that cannot be decoded, or whose data are damaged.

Copies of frames are found in the same pass through the video.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture.cameras import CaptureCamera
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.model.copied_frames import Pictures, find_pictures
from bodycap_batch.model.frozen_frames import picture_change_px
from bodycap_batch.model.optical_flow import GreyImage, make_coarse_image


def find_damage_and_copies(camera: CaptureCamera) -> tuple[IntArray, Pictures | None]:
    """Decode all frames of a camera, and find the damaged frames and the copies of the frame before.

    Returns:
        (D,) indices of the damaged frames; and the frames that are no copies, None if there are no copies.
    """
    change_px = np.full(len(camera.frame_numbers), np.nan)
    is_damaged = np.ones(len(change_px), dtype=bool)
    before: GreyImage | None = None
    for shot in camera.frame_candidates():
        image = make_coarse_image(shot.grey)
        is_damaged[shot.index] = False
        if before is not None:
            change_px[shot.index] = picture_change_px(before, image)
        before = image
    unknown = np.full(len(change_px), np.nan)
    return np.flatnonzero(is_damaged), find_pictures(change_px, unknown, camera.times_ns)


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
