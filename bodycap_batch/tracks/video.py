"""Follow points through a video, or through even parts of a long one."""

from __future__ import annotations

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks.tracker import PointTracker

_ALL_FRAMES = 600
"""Maximum number of frames that are tracked. Of a longer video, even parts are tracked."""
_STRETCH_FRAMES = 30
"""Number of successive frames of such a part: three times the time over which motion is compared."""


def track_video(camera: CaptureCamera, context: StageContext) -> PointTracks:
    """Follow points through a video, or through even parts of a long one.

    Args:
        camera: The camera with its video.
        context: Progress and cancellation.
    """
    count, lens = len(camera.times_ns), camera.camera
    tracker = PointTracker(
        camera=camera.name, width_px=lens.width_px, height_px=lens.height_px, mask=camera.mask
    )
    stretches = [(0, count)]
    if count > _ALL_FRAMES:
        starts = np.linspace(0, count - _STRETCH_FRAMES, _ALL_FRAMES // _STRETCH_FRAMES).astype(int)
        stretches = [(start, start + _STRETCH_FRAMES) for start in starts.tolist()]
    done, total = 0, sum(stop - start for start, stop in stretches)
    for start, stop in stretches:
        tracker.restart()
        for index, grey in camera.read_decodable(np.arange(start, stop)):
            context.check_cancelled()
            tracker.add(index, grey)
            if index % 30 == 0:
                context.progress(done + index - start, total, "frames searched for the own hand")
        done += stop - start
    return tracker.tracks(count)
