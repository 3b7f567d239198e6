"""The task that refuses a job that cannot work."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, write_summary


def _check(_: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.check import require_ready, require_within_limits
    from bodycap_batch.config.limits import Limits
    from bodycap_batch.config.models import Job

    context.check_cancelled()
    job = Job.model_validate(arguments["job"])
    if (limits := arguments.get("limits")) is not None:
        require_within_limits(job, Limits(**limits))
    report = require_ready(job, context.threads)
    notes = [f"{camera.name}: {note}" for camera in report.cameras for note in camera.notes]
    frames = sum(camera.used_frames for camera in report.cameras)
    large = sum(camera.large_frames for camera in report.cameras)
    write_summary(files, notes=[*notes, *report.notes], frames=frames, large_frames=large)


CHECK = Stage(function=_check, libraries=VISION, modules=SEEING)
