"""`bodycap report`."""

from __future__ import annotations

from pathlib import Path

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
from bodycap_batch.cli.terminal import print_line


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

    Every run writes the report. This command writes the report again, for example with a newer bodycap. The
    job may also be given by its results folder. No other stage is computed. The report of an interrupted job
    states how far the job got.

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
    print_line(f"report: {path}")


def job_from_path(path_argument: Path) -> tuple[Path, Path | None]:
    """Return the job to load for a path, and the results folder.

    If the path is not a results folder, the path itself is the job, and the returned results folder is None.
    """
    if (path_argument / "run.json").is_file() and (path_argument / "job.yaml").is_file():
        return path_argument / "job.yaml", path_argument.resolve()
    return path_argument, None
