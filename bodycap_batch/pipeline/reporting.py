"""Make the report of a job again, from results that an earlier run stored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bodycap_batch.config.folder import PARTIAL, RUN_FILE
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.pipeline import flow
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.results import publish
from bodycap_batch.pipeline.run import files_of, run_stages
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.stage_results import StageResults, report_task
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.runner import NotStored
from bodycap_batch.tasks.report import ReportTask


def stored_for_report(job: Job, *, out_dir: Path, settings: Settings) -> ReportTask:
    """Find the stored results that a job's report needs; nothing is computed.

    Args:
        job: A resolved job.
        out_dir: Folder of the job's results.
        settings: Settings of the run: store, threads, listener, cancellation.

    Returns:
        The report's task, for `bodycap_batch.tasks.report.load_inputs`.

    Raises:
        BodycapError: The videos cannot be read, the disk fails, or nothing of the job is stored.
    """
    results, stopped_by = find_stored(job, out_dir, settings)
    return report_task(results, settings.store.digests, stopped_by)


def find_stored(
    job: Job, out_dir: Path, settings: Settings, *, last: str = "export"
) -> tuple[StageResults, BodycapError | None]:
    """Return the stored results of all stages up to the stage `last`.

    If the results of a stage are not stored, the returned results end before this stage, and the second value
    is the error that names the stage. Otherwise the second value is None.
    """
    results = StageResults(facts=JobFacts.of(job))
    with StageRunner.of(job, replace(settings, compute=False, redo=frozenset()), out_dir) as runner:
        try:
            for stage in run_stages(runner, results):
                if stage == last:
                    break
        except NotStored as error:
            if not runner.records:
                raise
            return results, error
    return results, None


def remake_report(job: Job, *, out_dir: Path, settings: Settings) -> Path:
    """Write a job's report again from stored results.

    The report is computed. The check of the job is also computed if its result is not stored.

    Args:
        job: A resolved job.
        out_dir: Folder of the job's results.
        settings: Settings of the run: store, threads, listener, cancellation.

    Returns:
        The path of the report: in `out_dir` if the job is complete, else in ``<out_dir>/partial``.

    Raises:
        BodycapError: The videos cannot be read, the disk fails, nothing of the job is stored, or the folder
            holds the results of another version of the program or of other options. Its report stays.
    """
    results, stopped_by = find_stored(job, out_dir, settings)
    if isinstance(stopped_by, NotStored) and (out_dir / RUN_FILE).is_file():
        raise StoreError(
            "these results are not those of this version of bodycap with these options, so their report "
            f"stays as it is: {stopped_by.message}",
            path=out_dir,
            hint=stopped_by.hint,
        )
    again = replace(settings, redo=settings.redo | {"report"})
    with StageRunner.of(job, again, out_dir) as runner:
        flow.check(runner, StageResults(facts=JobFacts.of(job)))
        reported = flow.report(runner, results, stopped_by)
    is_complete = results.exported is not None and results.failure is None
    folder = out_dir if is_complete else out_dir / PARTIAL
    settings.raise_if_cancelled()
    files = dict(files_of(reported))
    publish(files, folder)
    return folder / next(iter(files))
