"""`bodycap init`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.terminal import print_line, print_lines
from bodycap_batch.core.errors import CaptureError, JobError


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A folder of videos.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing job file.")] = False,
) -> None:
    """Write a job.yaml with comments for the videos in a folder.

    The file lists every camera, and every option with its default and meaning. Fill in the values that the
    videos do not contain.

    \b
    Example:
      bodycap init my_walk/
      bodycap check my_walk/job.yaml
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.check.job_template import write_job_template
    from bodycap_batch.check.overview import overview_lines
    from bodycap_batch.config.rules import UNKNOWN_MOUNT

    path = write_job_template(folder, replace=force)
    text = path.read_text(encoding="utf-8")
    print_line(f"wrote {path}")
    try:
        print_lines(overview_lines(path))
    except (JobError, CaptureError) as error:
        print_line(f"problem: {error}")
    missing = text.count(UNKNOWN_MOUNT)
    if missing:
        print_line(
            f"first, fill in `mount:` (the place on the body) of {missing} "
            f"camera{'s' if missing > 1 else ''} in the file"
        )
    print_line(f"next: bodycap check {shlex.quote(str(path))}")
