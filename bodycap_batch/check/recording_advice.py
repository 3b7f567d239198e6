"""Give advice on a job that can run: what would improve its result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bodycap_batch.check.check_report import CameraSummary
from bodycap_batch.config.models import Job

_MAX_ADVICE = 3
"""Maximum number of sentences of advice. Evidence: none."""
_LOW_FPS = 24.0
"""Minimum number of frames per second that needs no advice.

At a lower rate swinging arms are poorly sampled. Cinema cameras run at 24 frames per second. Evidence: none.
"""
_MAX_MISSING_S = 3.0
"""Maximum time (seconds) without frames of a camera that needs no advice.

The time is measured at the start or at the end of the capture. Evidence: none.
"""
_MAX_MISSING_RATIO = 0.1
"""Maximum time without frames of a camera, as a fraction of the capture's duration.

This fraction and `_MAX_MISSING_S` limit the same time. The larger of the two limits is used. Evidence: none.
"""
_SECONDS_PER_VIDEO_SECOND = (1.3, 5.0)
"""Computation time (seconds) for one second of one camera's video on two cores.

The first value is for an easy capture, the second value is for a hard capture. Evidence:
docs/decisions/check.md.
"""
_LONG_CAPTURE_S = 60.0
"""Maximum duration (seconds) of the videos of all cameras together that needs no estimate.

For longer videos the advice contains an estimate of the computation time. Evidence: none.
"""


def advise(job: Job, cameras: Sequence[CameraSummary]) -> list[str]:
    """Return at most three sentences of advice, the most important sentences first.

    Each sentence gives a reason and a remedy.

    Args:
        job: A resolved job without errors.
        cameras: The summary of each camera.
    """
    if not cameras:
        return []
    found = [
        *_intrinsics_advice(cameras),
        *_missing_time_advice(job, cameras),
        *_frame_rate_advice(cameras),
        *_duration_advice(cameras),
    ]
    return found[:_MAX_ADVICE]


def _intrinsics_advice(cameras: Sequence[CameraSummary]) -> Iterator[str]:
    guessed = [camera.name for camera in cameras if camera.guessed_lens]
    if guessed:
        yield (
            f"the program estimates the lens of {_joined_names(guessed)} together with the map. This works "
            "if the person moves sideways a lot; it is safer to film a board for half a minute and to run "
            "bodycap calibrate"
        )


def _missing_time_advice(job: Job, cameras: Sequence[CameraSummary]) -> Iterator[str]:
    if not all(config.offset_s is not None for config in job.capture.cameras):
        return
    start, end = (
        min(camera.start_s for camera in cameras),
        max(camera.end_s for camera in cameras),
    )
    for camera in cameras:
        late, early = camera.start_s - start, end - camera.end_s
        missing = max(late, early)
        if missing > max(_MAX_MISSING_S, _MAX_MISSING_RATIO * (end - start)):
            when = "starts" if late >= early else "ends"
            order = "after" if late >= early else "before"
            yield (
                f"{camera.name} {when} {missing:.1f} s {order} the others, and during this time the motion "
                "of its bone is only inferred. To use only the time in which all cameras recorded, set "
                "start_s and end_s"
            )


def _frame_rate_advice(cameras: Sequence[CameraSummary]) -> Iterator[str]:
    for camera in cameras:
        if camera.fps < _LOW_FPS:
            yield (
                f"{camera.name} records {camera.fps:.3g} frames per second. This is enough for a slow "
                "walk, but hardly enough for swinging arms; film at 30 frames per second or more, and at "
                "60 for fast movement"
            )


def _duration_advice(cameras: Sequence[CameraSummary]) -> Iterator[str]:
    seconds = sum(camera.used_frames / camera.fps for camera in cameras if camera.fps > 0)
    if seconds > _LONG_CAPTURE_S:
        least, most = (max(1.0, factor * seconds / 60.0) for factor in _SECONDS_PER_VIDEO_SECOND)
        yield (
            f"the videos last {seconds:.0f} s in all: expect a run time of {least:.0f} to {most:.0f} "
            "minutes on two cores. To see sooner whether the recording is usable, run a short part first "
            "(start_s, end_s)"
        )


def _joined_names(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
