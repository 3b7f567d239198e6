"""The report of a job that was run before, made again from what the store holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.made import Made, report_task
from bodycap_batch.pipeline.results import PARTIAL, publish
from bodycap_batch.pipeline.run import files_of, run_stages
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.runner import NotStored


def stored_for_report(job: Job, *, out_dir: Path, settings: Settings) -> Mapping[str, Any]:
    """Where the store holds what a job's report is made of; nothing is computed.

    Args:
        job: A resolved job.
        out_dir: Folder of its results.
        settings: Store, threads, listener, cancellation.

    Returns:
        The arguments of the report's task, for `bodycap_batch.tasks.report.load_inputs`.

    Raises:
        BodycapError: The videos cannot be read, the disk fails, or nothing of the job is stored.
    """
    made, stopped_by = _stored(job, out_dir, settings)
    error = stopped_by or made.failure
    return report_task(job, made, {}, None if error is None else made.failed_at(error)).arguments


def _stored(job: Job, out_dir: Path, settings: Settings) -> tuple[Made, BodycapError | None]:
    """The finished stages up to the results, and what the store lacks of them."""
    made = Made()
    with Flow(job, replace(settings, compute=False, redo=frozenset()), logs=out_dir / "logs") as looking:
        try:
            for stage in run_stages(job, looking, made):
                if stage == "export":
                    break
        except NotStored as error:
            if not looking.records:
                raise
            return made, error
    return made, None


def remake_report(job: Job, *, out_dir: Path, settings: Settings) -> Path:
    """Write a job's report anew; no other stage is computed.

    Args:
        job: A resolved job.
        out_dir: Folder of its results.
        settings: Store, threads, listener, cancellation.

    Returns:
        The report: beside the results where the job is complete, else in ``<out_dir>/partial``.

    Raises:
        BodycapError: The videos cannot be read, the disk fails, or nothing of the job is stored.
    """
    made, stopped_by = _stored(job, out_dir, settings)
    again = replace(settings, redo=settings.redo | {"report"})
    with Flow(job, again, logs=out_dir / "logs") as flow:
        flow.check()
        reported = flow.report(made, stopped_by)
    whole = made.exported is not None and made.failure is None
    folder = out_dir if whole else out_dir / PARTIAL
    settings.require_owner()
    files = dict(files_of(reported))
    publish(files, folder)
    return folder / next(iter(files))
