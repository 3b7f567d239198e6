"""`bodycap view`."""

from __future__ import annotations

import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.open_report import report_page
from bodycap_batch.cli.shared_options import (
    JobArgument,
    OutOption,
    StoreOption,
    command_settings,
    results_folder,
)
from bodycap_batch.cli.terminal import print_line, print_message
from bodycap_batch.core.errors import BodycapError
from bodycap_batch.job_places import capture_of_results, find_store, load_last_run

if TYPE_CHECKING:
    from bodycap_batch.config.models import Job
    from bodycap_batch.report.frame_overlays import FrameOverlays
    from bodycap_batch.report.report_inputs import ReportInputs


@app.command(short_help="Show the report of a finished job together with the videos.")
def view(
    job: JobArgument,
    out: OutOption = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the server (default: a free one).")
    ] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True,
    rerun: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rrd", help="Write a recording for the Rerun viewer instead of starting a server."
        ),
    ] = None,
    store: StoreOption = None,
) -> None:
    """Show a finished job in the browser, together with its videos.

    Serves the report on this machine only (127.0.0.1) until Ctrl-C. The report itself, report.html, needs no
    server; it shows small pictures instead of the videos. Points and skeleton are drawn over every frame if
    the store still holds them, otherwise over the small pictures only.

    \b
    Examples:
      bodycap view out/my_walk
      bodycap view out/my_walk --rerun my_walk.rrd
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.overrides import Overrides
    from bodycap_batch.report.recording import write_recording
    from bodycap_batch.report.serving import LOOPBACK, make_served_content, make_server

    resolved = load_last_run(job, Overrides(out=out))
    out_dir = results_folder(resolved)
    store = store or find_store(out_dir)
    if rerun is not None:
        write_recording(_stored_inputs(resolved, out_dir, store), rerun)
        print_line(f"recording: {rerun}")
        return
    page = report_page(out_dir)
    server = make_server(
        make_served_content(
            page, capture_of_results(resolved, out_dir), _StoredMarks(resolved, out_dir, store)
        ),
        port,
    )
    address = f"http://{LOOPBACK}:{server.server_port}/report.html?videos"
    print_line(f"{address}  (Ctrl-C ends the server)")
    if browser:
        webbrowser.open(address)
    with server:
        server.serve_forever()


def _stored_inputs(job: Job, out_dir: Path, store: Path) -> ReportInputs:
    """Read the inputs of a job's report from the store."""
    from bodycap_batch.pipeline import stored_for_report
    from bodycap_batch.tasks.report import load_inputs

    settings = command_settings(out_dir, store)
    return load_inputs(stored_for_report(job, out_dir=out_dir, settings=settings))


class _StoredMarks:
    """Finds the points and skeleton to draw over video frames. The first call reads them from the store."""

    def __init__(self, job: Job, out_dir: Path, store: Path) -> None:
        self._of = (job, out_dir, store)
        self._lock = threading.Lock()
        self._marks: FrameOverlays | None = None
        self._looked = False

    def __call__(self, camera: str, first: int) -> list[dict[str, Any]]:
        """Return the points and skeleton to draw over `FRAMES_PER_PART` frames, starting with frame `first`.

        The list is empty if the store does not hold the results.
        """
        from bodycap_batch.report.serving import FRAMES_PER_PART

        with self._lock:
            if not self._looked:
                self._looked = True
                self._marks = self._stored()
            return [] if self._marks is None else self._marks.describe_part(camera, first, FRAMES_PER_PART)

    def _stored(self) -> FrameOverlays | None:
        from bodycap_batch.report.frame_overlays import FrameOverlays

        try:
            inputs = _stored_inputs(*self._of)
        except BodycapError as error:
            reason = error.message
        else:
            if inputs.registrations:
                return FrameOverlays(inputs)
            reason = "the store no longer contains the camera paths of this job (run the job again)"
        print_message(
            "the points and the skeleton are not drawn over the videos, only over the pictures in the "
            f"report: {reason}"
        )
        return None
