"""`bodycap init`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app


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
    from bodycap_batch.check.job_template import UNKNOWN_MOUNT, write_job_template

    path = write_job_template(folder, replace=force)
    text = path.read_text(encoding="utf-8")
    typer.echo(f"wrote {path}")
    missing = text.count(UNKNOWN_MOUNT)
    if missing:
        typer.echo(
            f"first, fill in `mount:` (the place on the body) of {missing} "
            f"camera{'s' if missing > 1 else ''} in the file"
        )
    typer.echo(f"next: bodycap check {shlex.quote(str(path))}")
