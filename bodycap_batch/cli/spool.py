"""`bodycap status`, `retry` and `cancel`: the jobs of a watched folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.terminal import print_json, print_line, print_lines, table_lines
from bodycap_batch.core.percent import format_percent
from bodycap_batch.core.printable import printable

if TYPE_CHECKING:
    from bodycap_batch.watch import JobRow, Spool

SpoolArgument = Annotated[
    Path,
    typer.Argument(
        metavar="[DIR]", help="The watched folder, or the folder that contains inbox/, running/ and done/."
    ),
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the job in `bodycap status`.")]
_ENDED = ("done", "failed", "cancelled")
"""States of a job that has ended. Its time is the duration of its run."""
_TIME_UNITS = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
"""Units for the display of a job's time: the length (seconds) and the symbol of each unit."""
_MAX_CAUSE_LENGTH = 200
"""Maximum length, in characters, of the text for the cause of a failure in the table. A longer text is cut,
because it would make the row hard to read."""


@app.command(short_help="List the jobs of a watched folder and their states.")
def status(
    spool: SpoolArgument = Path("jobs"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the jobs and the watcher as JSON.")] = False,
) -> None:
    """List the jobs of a watched folder with state, stage, progress, time, verdict and cause of failure.

    The time is the duration of a job that has ended, and else the time since it waits or runs. Also shows the
    watcher of the folder.

    \b
    Examples:
      bodycap status
      bodycap status /mnt/nas/jobs --json
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.store.artefacts import disk_errors
    from bodycap_batch.watch import active_watcher, job_rows

    watched = _find_spool(spool)
    with disk_errors(watched.root):
        rows, watcher = job_rows(watched), active_watcher(watched)
    if as_json:
        found = {
            "jobs": [row.to_dict() for row in rows],
            "watchers": [] if watcher is None else [watcher.to_dict()],
        }
        print_json(found, indent=1)
        return
    print_lines(_job_table(rows))
    if watcher is not None:
        print_line(str(watcher))
    elif any(row.state in ("waiting", "interrupted", "stopped") for row in rows):
        print_line(f"no watcher runs for this folder; start a watcher with: bodycap watch {watched.inbox}")


@app.command()
def retry(name: NameArgument, spool: SpoolArgument = Path("jobs")) -> None:
    """Move a failed or cancelled job back to the inbox.

    Before that, you may correct the files of the job in failed/NAME/input/. Finished stages are not computed
    again.

    \b
    Example:
      bodycap retry kitchen_walk
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.watch import retry_job

    print_line(f"the job is in the inbox again: {retry_job(_find_spool(spool), name)}")


@app.command()
def cancel(name: NameArgument, spool: SpoolArgument = Path("jobs")) -> None:
    """Cancel a waiting or running job. The results of its finished stages stay in the store for a retry.

    \b
    Example:
      bodycap cancel kitchen_walk
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.watch import cancel_job, read_status

    place = cancel_job(_find_spool(spool), name)
    if place is None:
        print_line(
            f"{name}: no watcher has cancelled the job yet; the next watcher that runs will cancel the job"
        )
    elif (state := read_status(place).get("state")) != "cancelled":
        print_line(
            f"{name}: the job ended before it could be cancelled; its state is {state}, its folder is "
            f"{place.path}"
        )
    else:
        print_line(f"cancelled: {place.path}")


def _find_spool(path: Path) -> Spool:
    from bodycap_batch.core.errors import JobError
    from bodycap_batch.watch import spool_from_path

    if not path.is_dir():
        raise JobError(
            "there is no such folder", path=path, hint="give the watched folder, for example jobs/inbox"
        )
    return spool_from_path(path)


def _job_table(rows: list[JobRow]) -> list[str]:
    if not rows:
        return ["no jobs"]
    cells = [("JOB", "STATE", "STAGE", "PROGRESS", "TIME", "VERDICT", "")]
    for row in rows:
        progress = "" if row.progress is None else format_percent(row.progress)
        time = _time_text(row.duration_s if row.state in _ENDED else row.age_s)
        cause = printable(" ".join((row.cause or row.headline).split()))
        cause = cause if len(cause) <= _MAX_CAUSE_LENGTH else f"{cause[: _MAX_CAUSE_LENGTH - 1]}…"
        name, state, stage, verdict = map(printable, (row.name, row.state, row.stage, row.verdict))
        cells.append((name, state, stage, progress, time, verdict, cause))
    return table_lines(cells)


def _time_text(seconds: float | None) -> str:
    if seconds is None:
        return ""
    for size, unit in _TIME_UNITS:
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 0.0):.0f} s"
