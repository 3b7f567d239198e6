"""`bodycap run`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import JsonLines, ProgressDisplay, make_progress_display, print_event
from bodycap_batch.cli.shared_options import (
    ActivityOption,
    CamerasOption,
    HeightOption,
    JobArgument,
    JsonProgressOption,
    MemoryOption,
    OutOption,
    PlacesOption,
    RequireOption,
    SkeletonOption,
    StoreOption,
    ThreadsOption,
    checked_requirement,
    make_overrides,
)
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_line, print_text
from bodycap_batch.core.errors import BodycapError, JobError
from bodycap_batch.core.progress import Event
from bodycap_batch.job_places import find_job
from bodycap_batch.tasks.order import CHECK_MODULES, STAGE_ORDER, StageName

if TYPE_CHECKING:
    from bodycap_batch.pipeline import RunSummary


@app.command()
def run(  # noqa: PLR0913, PLR0917 - the flags a user types
    job: JobArgument,
    out: OutOption = None,
    skeleton: SkeletonOption = None,
    height: HeightOption = None,
    camera: CamerasOption = None,
    places: PlacesOption = None,
    require: RequireOption = None,
    activity: ActivityOption = None,
    threads: ThreadsOption = None,
    store: StoreOption = None,
    memory_mb: MemoryOption = None,
    from_: Annotated[
        StageName | None, typer.Option("--from", help="Repeat this stage and all later ones.")
    ] = None,
    until: Annotated[
        StageName | None,
        typer.Option(help="Stop after this stage. Only the last stage writes the results folder."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Repeat every stage.")] = False,
    json_progress: JsonProgressOption = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", help="At the end, print the time and the memory that each stage used."
        ),
    ] = False,
) -> None:
    """Compute the map, the camera paths and the motion of a capture.

    The results of finished stages stay in the store. If a run was stopped, or if you start a run again with
    other options, only the missing stages are computed. The last printed line names the results folder.

    \b
    Examples:
      bodycap run my_walk/ --height 1.75
      bodycap run my_walk/ --skeleton subject.bvh --out results/my_walk
      bodycap run single_camera/ --skeleton none
      bodycap run jobs/cpl_lab.yaml
      bodycap run my_walk/ --from merge
      bodycap run my_walk/ --require good,0.9   exit code 6 if it is not reached
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.api import Execution, execute_job, prepare_job
    from bodycap_batch.config.body_height import describe_height
    from bodycap_batch.config.folder import RUN_FILE, job_file_in
    from bodycap_batch.runner import Children

    if force and from_ is not None:
        raise JobError(
            "--force and --from cannot be used together: --force repeats all stages, --from repeats only "
            "some stages",
            hint="use only one of the two options",
        )
    first_repeated: StageName | None = "check" if force else from_
    with (
        event_on_signal() as stop,
        make_progress_display(as_json=json_progress) as display,
        _report_errors_as_json(display),
    ):

        def announce(text: str) -> None:
            display(Event(kind="note", stage="", what=text))

        execution = Execution(
            store=store,
            threads=threads,
            memory_mb=memory_mb,
            progress=display,
            cancelled=stop.is_set,
            children=Children(),
            redo=_stages_from(first_repeated),
            until=until or "",
            results_ready=lambda folder: announce(
                f"the results are in {folder}; only preview.mp4 is still being made"
            ),
        )
        place = find_job(job)
        job_file = place.file if place.results else job_file_in(job) if job.is_dir() else None
        if job_file is not None:
            announce(f"the settings are taken from {job_file}")
        overrides = make_overrides(out, skeleton, height, camera, activity, places)
        overrides = replace(overrides, require=checked_requirement(require))
        loaded = prepare_job(job, overrides, execution)
        if height is not None and loaded.options.height_m is not None:
            announce(f"height of the subject: {describe_height(loaded.options.height_m)}")
        display.expect_cameras(len(loaded.cameras))
        for text in loaded.warnings:
            announce(text)
        if execution.children is not None and not (loaded.out / RUN_FILE).exists():
            # With results, all stages may be stored, which needs no child. The child loads the libraries of
            # the first stage while this process imports the pipeline.
            execution.children.start_ahead(CHECK_MODULES)
        summary = execute_job(loaded, execution)
    _print_summary(summary, loaded.name, display, verbose=verbose)
    if summary.unmet is not None:
        with _report_errors_as_json(display):
            raise summary.unmet


def _stages_from(first: StageName | None) -> frozenset[str]:
    """Return the names of the stages that are repeated, from the first one on; none for None."""
    if first is None:
        return frozenset()
    from bodycap_batch.tasks.stages import stages_from

    return stages_from(first)


@contextmanager
def _report_errors_as_json(display: ProgressDisplay) -> Iterator[None]:
    """Print an error as JSON before it is raised again, if the progress is displayed as JSON lines."""
    try:
        yield
    except BodycapError as error:
        if isinstance(display, JsonLines):
            print_event({"kind": "error", **error.to_dict()})
        raise


def _print_summary(summary: RunSummary, name: str, display: ProgressDisplay, *, verbose: bool) -> None:
    if isinstance(display, JsonLines):
        last = {"kind": "done", "out_dir": str(summary.out_dir), "files": list(summary.files)}
        verdict = None if summary.verdict is None else summary.verdict.to_dict()
        print_event({**last, "executed": summary.executed, "verdict": verdict})
        return
    if verbose:
        for stage in summary.stages:
            cost = f"{stage.seconds:8.1f} s {stage.peak_memory_mb:7.0f} MB"
            print_line(
                f"{cost}  {stage.stage} {stage.camera}{' (already done)' if stage.reused else ''}".rstrip()
            )
    if not summary.files:
        # Report the last stage with a name that the user knows. Stages such as rig and recover belong to
        # registration.
        reached = next(stage.stage for stage in reversed(summary.stages) if stage.stage in STAGE_ORDER)
        print_line(
            f"{name}: stopped after the stage {reached}, as requested; run the job again without "
            "--until to compute the other stages"
        )
        return
    from bodycap_batch.report import REPORT_FILE

    if summary.executed == 0:
        print_line(f"{name}: nothing to do, because all {len(summary.stages)} stages were already done")
    for line in () if summary.verdict is None else summary.verdict.lines():
        print_text(line)
    print_line(f"open first: {summary.out_dir / REPORT_FILE}")
    print_line(f"results: {summary.out_dir}")
