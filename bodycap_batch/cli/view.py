"""`bodycap view`."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.base import app
from bodycap_batch.cli.options import JobArgument, OutOption, results_folder
from bodycap_batch.cli.report import job_of
from bodycap_batch.errors import JobError

_REPORT = ("report.html", "partial/report.html")


@app.command()
def view(
    job: JobArgument,
    out: OutOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port (default: a free one).")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the browser.")] = True,
    rerun: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a recording for the Rerun viewer instead, and end."),
    ] = None,
) -> None:
    """Look at a finished job in the browser, with its real videos in sync.

    Serves the report on this machine alone (127.0.0.1) until Ctrl-C. JOB may be the folder of the results.
    The report itself, report.html, needs no server; it shows small pictures in the place of the videos.

    \b
    Examples:
      bodycap view out/my_walk
      bodycap view out/my_walk --rerun my_walk.rrd
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.capture import open_capture
    from bodycap_batch.config.job import Overrides, load_job
    from bodycap_batch.report.recording import write_recording
    from bodycap_batch.report.serving import LOOPBACK, make_server, what_to_serve

    file, folder = job_of(job)
    resolved = load_job(file, Overrides(out=out or folder))
    out_dir = results_folder(resolved)
    if rerun is not None:
        write_recording(out_dir, rerun)
        typer.echo(f"recording: {rerun}")
        return
    page = next((out_dir / name for name in _REPORT if (out_dir / name).is_file()), None)
    if page is None:
        raise JobError("there is no report", path=out_dir, hint="run the job, or `bodycap report` it")
    server = make_server(what_to_serve(page, open_capture(resolved.capture)), port)
    address = f"http://{LOOPBACK}:{server.server_port}/report.html?videos"
    typer.echo(f"{address}  (Ctrl-C ends)")
    if browser:
        webbrowser.open(address)
    with server:
        server.serve_forever()
