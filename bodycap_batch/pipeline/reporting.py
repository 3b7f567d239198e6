"""The report of a job that was run before, made again from what the store holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bodycap_batch.config.models import Job
from bodycap_batch.errors import BodycapError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.made import Made
from bodycap_batch.pipeline.results import PARTIAL, publish
from bodycap_batch.pipeline.run import files_of, run_stages
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.runner import NotStored


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
    made = Made()
    stopped_by: BodycapError | None = None
    with Flow(job, replace(settings, compute=False, redo=frozenset()), logs=out_dir / "logs") as looking:
        try:
            for stage in run_stages(job, looking, made):
                if stage == "export":
                    break
        except NotStored as error:
            if not looking.records:
                raise
            stopped_by = error
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
