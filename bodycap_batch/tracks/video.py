"""Follow points through a video."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks.tracker import PointTracker


def track_video(camera: CaptureCamera, progress: Callable[[int, int], None]) -> PointTracks:
    """Follow points through a video.

    Args:
        camera: The camera with its video.
        progress: Receives the number of finished frames and of all frames.
    """
    count, lens = len(camera.times_ns), camera.camera
    tracker = PointTracker(
        camera=camera.name, width_px=lens.width_px, height_px=lens.height_px, mask=camera.mask
    )
    for index, grey in camera.read_decodable(np.arange(count)):
        tracker.add(index, grey)
        progress(index + 1, count)
    return tracker.tracks(count)
