"""The task that checks a job and refuses a job that cannot run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import Job
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import BodyInput, StatedClock
from bodycap_batch.tasks.stage import write_summary
from bodycap_batch.tasks.typed_json import omitted_from_key


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckTask:
    """Check a job before anything is computed.

    Attributes:
        job: The resolved job. The job is not part of the artefact's key, because the other fields hold
            everything that the check depends on.
        cameras: For each camera name, the digest of everything that the camera's frames depend on.
        clocks: What is stated about the clock of each camera, by camera name.
        body: The body; None for a job without a skeleton.
        formats: Formats of the files to export.
        names: The convention for the joint names in the exported files.
        limits: Maximum sizes of the videos; None (no limits) for a job that the user runs directly.
    """

    job: Job = field(metadata=omitted_from_key())
    cameras: Mapping[str, str]
    clocks: Mapping[str, StatedClock]
    body: BodyInput | None
    formats: tuple[str, ...]
    names: str
    limits: Limits | None


def run_check(task: CheckTask, context: StageContext, files: Path) -> None:
    """Check the job; store the notes for the user and the numbers of frames."""
    from bodycap_batch.check import require_ready, require_within_limits
    from bodycap_batch.telemetry.gopro import has_telemetry_track, states_stabilisation

    if task.limits is not None:
        require_within_limits(task.job, task.limits)
    report = require_ready(task.job, context.threads)
    notes = [f"{camera.name}: {note}" for camera in report.cameras for note in camera.notes]
    frames = sum(camera.used_frames for camera in report.cameras)
    large = sum(camera.large_frames for camera in report.cameras)
    notes += report.notes
    cameras = task.job.capture.cameras
    telemetry = [camera.name for camera in cameras if any(map(has_telemetry_track, camera.video))]
    stabilised = [camera.name for camera in cameras if any(map(states_stabilisation, camera.video))]
    write_summary(
        files, notes=notes, frames=frames, large_frames=large, telemetry=telemetry, stabilised=stabilised
    )
