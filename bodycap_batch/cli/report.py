"""`bodycap report`."""

from __future__ import annotations

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import make_progress_display
from bodycap_batch.cli.shared_options import (
    HeightOption,
    JobArgument,
    OutOption,
    SkeletonOption,
    StoreOption,
    ThreadsOption,
    command_settings,
    make_overrides,
    results_folder,
)
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_line
from bodycap_batch.job_places import load_last_run


@app.command()
def report(
    job: JobArgument,
    out: OutOption = None,
    skeleton: SkeletonOption = None,
    height: HeightOption = None,
    threads: ThreadsOption = None,
    store: StoreOption = None,
) -> None:
    """Write a job's report.html again, from the content of the store.

    Every run writes the report and verdict.json. This command writes both again, for example with a newer
    bodycap. The height and the skeleton are those of the last run. No other stage is computed. The report of
    an interrupted job states how far the job got.

    \b
    Examples:
      bodycap report out/my_walk
      bodycap report my_walk/ --height 1.75
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.pipeline import remake_report

    resolved = load_last_run(job, make_overrides(out, skeleton, height))
    out_dir = results_folder(resolved)
    with event_on_signal() as stop, make_progress_display(as_json=False) as display:
        settings = command_settings(out_dir, store, threads, listener=display, cancelled=stop.is_set)
        path = remake_report(resolved, out_dir=out_dir, settings=settings)
    print_line(f"report: {path}")
