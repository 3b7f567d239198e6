"""`bodycap open`."""

from __future__ import annotations

import webbrowser
from pathlib import Path

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import JobArgument, OutOption, make_overrides, results_folder
from bodycap_batch.cli.terminal import print_line
from bodycap_batch.core.errors import JobError
from bodycap_batch.job_places import load_last_run

_REPORTS = ("report.html", "partial/report.html")
"""Names of the report in a folder of results. The second one is that of a job that stopped early."""


@app.command("open")
def open_report(job: JobArgument, out: OutOption = None) -> None:
    """Open the report of a job in the browser.

    The report is one file, and needs no server. `bodycap view` shows the same page with the videos.

    \b
    Examples:
      bodycap open out/my_walk
      bodycap open my_walk/
    """  # noqa: D301 - \b keeps lines as they are
    out_dir = results_folder(load_last_run(job, make_overrides(out)))
    page = report_page(out_dir)
    print_line(f"report: {page}")
    webbrowser.open(page.as_uri())


def report_page(out_dir: Path) -> Path:
    """Return the report in a folder of results. Raises `JobError` if there is none."""
    page = next((out_dir / name for name in _REPORTS if (out_dir / name).is_file()), None)
    if page is None:
        hint = "run the job, or write the report with `bodycap report`"
        raise JobError("the folder contains no report", path=out_dir, hint=hint)
    return page
