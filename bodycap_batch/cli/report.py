"""`bodycap report`."""

from __future__ import annotations

from pathlib import Path

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import make_progress_display
from bodycap_batch.cli.shared_options import (
    HeightOption,
    JobArgument,
    OutOption,
    SkeletonOption,
    StoreOption,
    ThreadsOption,
    cores,
    default_store,
    results_folder,
)
from bodycap_batch.cli.signals import event_on_signal


@app.command()
def report(
    job: JobArgument,
    out: OutOption = None,
    skeleton: SkeletonOption = None,
    height: HeightOption = None,
    threads: ThreadsOption = None,
    store: StoreOption = None,
) -> None:
    """Write a job's report.html anew, from what the store holds.

    Every run writes it; this does it again, with a newer bodycap for instance. JOB may also be the folder of
    the results. No other stage is computed; of a job that broke off, the report says how far it came.

    \b
    Examples:
      bodycap report out/my_walk
      bodycap report my_walk/ --height 1.75
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.job import Overrides, load_job
    from bodycap_batch.pipeline import Settings, remake_report
    from bodycap_batch.store.artefacts import Store

    file, folder = job_from_path(job)
    resolved = load_job(file, Overrides(out=out or folder, skeleton=skeleton, height_m=height))
    out_dir = results_folder(resolved)
    with event_on_signal() as stop, make_progress_display(as_json=False) as display:
        settings = Settings(
            store=Store(store or default_store(out_dir)),
            threads=threads or cores(),
            listener=display,
            cancelled=stop.is_set,
        )
        path = remake_report(resolved, out_dir=out_dir, settings=settings)
    typer.echo(f"report: {path}")


def job_from_path(named: Path) -> tuple[Path, Path | None]:
    """The job to load, and the results' folder where that is what was named."""
    if (named / "run.json").is_file() and (named / "job.yaml").is_file():
        return named / "job.yaml", named.resolve()
    return named, None
