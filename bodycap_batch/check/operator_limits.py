"""Refuse a video that exceeds the operator's limits, before any frame is decoded."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.capture.video import open_container, video_stream
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import CaptureError


def require_within_limits(job: Job, limits: Limits) -> None:
    """Require that each video of a job is within the limits of size and duration.

    The size and the duration are read from the video's container.

    Args:
        job: The job.
        limits: The operator's limits.

    Raises:
        CaptureError: A video is larger or longer than permitted, or cannot be read.
    """
    for index, camera in enumerate(job.capture.cameras):
        for path in camera.video:
            _require_video_within_limits(path, limits, f"capture.cameras.{index}.video")


def _require_video_within_limits(path: Path, limits: Limits, field: str) -> None:
    with open_container(path) as container:
        stream = video_stream(container, path)
        side = max(stream.codec_context.width, stream.codec_context.height)
        seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        seconds = max(seconds, container.duration / 1e6 if container.duration else 0.0)
    if side > limits.video_px:
        raise CaptureError(
            f"the video is {side} pixels wide or high, but the limit is {limits.video_px:g} pixels",
            path=path,
            field=field,
            hint="convert the video to a smaller picture size, or ask the operator of the watched folder "
            "to raise --limit video_px",
        )
    if seconds > 3600 * limits.video_hours:
        raise CaptureError(
            f"the video lasts {seconds / 3600:.2f} hours, but the limit is {limits.video_hours:g} hours",
            path=path,
            field=field,
            hint="shorten the recording, or ask the operator of the watched folder to raise --limit "
            "video_hours",
        )
