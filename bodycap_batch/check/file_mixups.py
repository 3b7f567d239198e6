"""Find mixed-up video files: the same video for two cameras, or a missing chapter."""

from __future__ import annotations

import filecmp
import re
from itertools import combinations, pairwise
from pathlib import Path

from bodycap_batch.config.models import CameraConfig, Job
from bodycap_batch.core.errors import CaptureError

_GOPRO_CHAPTER = re.compile(r"G[HXL](?P<chapter>[0-9]{2})(?P<video>[0-9]{4})", re.IGNORECASE)


def require_distinct_videos(job: Job) -> None:
    """Refuse a job in which two cameras have the same video, or in which a chapter of a video is missing.

    Raises:
        CaptureError: Two cameras have the same video, or a chapter is missing. The error names the file.
    """
    for camera in job.capture.cameras:
        _require_all_chapters(camera)
    for first, second in combinations(job.capture.cameras, 2):
        for video in second.video:
            same_video = next((other for other in first.video if _is_same_content(other, video)), None)
            if same_video is not None:
                raise CaptureError(
                    f"camera {second.name} shows the same video as camera {first.name} ({same_video.name})",
                    path=video,
                    hint=f"copy the right video of camera {second.name}, or leave camera {second.name} out",
                )


def _is_same_content(first: Path, second: Path) -> bool:
    """Return True if two files have the same content and are not empty.

    The result is False if a file is missing. Another check reports missing files.
    """
    try:
        size = first.stat().st_size
        return size > 0 and size == second.stat().st_size and filecmp.cmp(first, second, shallow=False)
    except OSError:
        return False


def _require_all_chapters(camera: CameraConfig) -> None:
    """Require that no chapter of a GoPro recording is missing between two listed chapters.

    If a chapter were missing, all later frames would get times that are too early. A camera with a file of
    timestamps is not checked.

    Raises:
        CaptureError: A chapter is missing.
    """
    if camera.timestamps:
        return
    for before, after in pairwise(camera.video):
        numbers = [_GOPRO_CHAPTER.fullmatch(path.stem) for path in (before, after)]
        if not (numbers[0] and numbers[1] and numbers[0]["video"] == numbers[1]["video"]):
            continue
        last, following = (int(number["chapter"]) for number in numbers if number)
        if following > last + 1:
            raise CaptureError(
                f"chapter {last + 1} of recording {numbers[1]['video']} is missing between {before.name} and "
                f"{after.name}",
                path=after,
                hint="copy the missing chapter from the memory card; if the chapter is lost, list only "
                "the chapters before it, and set end_s to the end of these chapters",
            )
