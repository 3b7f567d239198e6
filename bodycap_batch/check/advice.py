"""What an experienced colleague would say about a job that can run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bodycap_batch.check.check_report import CameraSummary
from bodycap_batch.config.models import SKELETON_PRESETS, Job

_LOW_FPS = 24.0
_MAX_MISSING_S = 3.0
_MAX_MISSING_RATIO = 0.1
_SECONDS_PER_VIDEO_SECOND = (1.3, 5.0)
"""Seconds of computing for one of a camera's video, on two cores: the README's easy and hard captures."""
_LONG_CAPTURE_S = 60.0


def advise(job: Job, findings: Sequence[CameraSummary]) -> list[str]:
    """Sentences in the order of their weight; each says why and what to do.

    Args:
        job: A resolved job without errors.
        findings: One a camera.
    """
    if not findings:
        return []
    return [
        *_intrinsics_advice(findings),
        *_clock_advice(job, findings),
        *_length_advice(findings),
        *_scale_advice(job),
        *_duration_advice(findings),
    ]


def _intrinsics_advice(findings: Sequence[CameraSummary]) -> Iterator[str]:
    guessed = [finding.name for finding in findings if finding.guessed_lens]
    if guessed:
        yield (
            f"the lens of {_joined_names(guessed)} will be estimated along with the map. It works on walks with "
            "much sideways movement; half a minute of a filmed board (bodycap calibrate) is safer"
        )


def _clock_advice(job: Job, findings: Sequence[CameraSummary]) -> Iterator[str]:
    cameras = job.capture.cameras
    stated = any(camera.offset_s for camera in cameras) or any(camera.timestamps for camera in cameras)
    if len(findings) > 1 and not stated:
        yield (
            "no camera states an offset_s, so all videos are taken to start at the same instant. If each was "
            "started by hand, read the time of your clap in every video: offset_s = time in the first video "
            "- time in this one"
        )


def _length_advice(findings: Sequence[CameraSummary]) -> Iterator[str]:
    start, end = (
        min(finding.start_s for finding in findings),
        max(finding.end_s for finding in findings),
    )
    for finding in findings:
        late, early = finding.start_s - start, end - finding.end_s
        missing = max(late, early)
        if missing > max(_MAX_MISSING_S, _MAX_MISSING_RATIO * (end - start)):
            when = "starts" if late >= early else "ends"
            order = "after" if late >= early else "before"
            yield (
                f"{finding.name} {when} {missing:.1f} s {order} the others: what it carries is "
                "inferred there. start_s and end_s cut the job to the time all cameras ran"
            )
    for finding in findings:
        if finding.fps < _LOW_FPS:
            yield (
                f"{finding.name} runs at {finding.fps:.3g} frames a second: enough for a slow walk, "
                "hardly for swinging arms; 30 or more is better, 60 for fast movement"
            )


def _scale_advice(job: Job) -> Iterator[str]:
    if job.skeleton in SKELETON_PRESETS and job.skeleton != "none" and job.height_m is not None:
        yield (
            "with a height alone the bones are those of a standard body, several centimetres off for a real "
            "one. If the subject's own skeleton exists as BVH, give it: --skeleton subject.bvh"
        )


def _duration_advice(findings: Sequence[CameraSummary]) -> Iterator[str]:
    seconds = sum(finding.used_frames / finding.fps for finding in findings if finding.fps > 0)
    if seconds > _LONG_CAPTURE_S:
        least, most = (max(1.0, factor * seconds / 60.0) for factor in _SECONDS_PER_VIDEO_SECOND)
        yield (
            f"{seconds:.0f} s of video in all: expect {least:.0f} to {most:.0f} minutes on two cores. To see "
            "sooner whether it works, try a short stretch first (start_s, end_s)"
        )


def _joined_names(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
