"""`bodycap open`, `view`, `report` and `compare`: look at results."""

from __future__ import annotations

import functools
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import make_progress_display
from bodycap_batch.cli.shared_options import (
    HeightOption,
    JobArgument,
    JsonOption,
    OutOption,
    SkeletonOption,
    StoreOption,
    ThreadsOption,
    make_overrides,
    results_folder,
)
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_json, print_line, print_message
from bodycap_batch.core.errors import BodycapError, JobError
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
    from bodycap_batch.api import Execution
    from bodycap_batch.pipeline import stored_for_report
    from bodycap_batch.tasks.report import load_inputs

    settings = Execution(store=store, threads=1).settings(out_dir)
    return load_inputs(stored_for_report(job, out_dir=out_dir, settings=settings))


class _StoredMarks:
    """Finds the points and skeleton to draw over video frames. The first call reads them from the store."""

    def __init__(self, job: Job, out_dir: Path, store: Path) -> None:
        self._of = (job, out_dir, store)
        self._lock = threading.Lock()

    def __call__(self, camera: str, first: int) -> list[dict[str, Any]]:
        """Return the points and skeleton to draw over `FRAMES_PER_PART` frames, starting with frame `first`.

        The list is empty if the store does not hold the results.
        """
        from bodycap_batch.report.serving import FRAMES_PER_PART

        with self._lock:
            overlays = self._overlays
        return [] if overlays is None else overlays.describe_part(camera, first, FRAMES_PER_PART)

    @functools.cached_property
    def _overlays(self) -> FrameOverlays | None:
        from bodycap_batch.report.frame_overlays import FrameOverlays

        try:
            inputs = _stored_inputs(*self._of)
            if inputs.registrations:
                return FrameOverlays(inputs)
            reason = "the store no longer contains the camera paths of this job (run the job again)"
        except BodycapError as error:
            reason = error.message
        print_message(
            "the points and the skeleton are not drawn over the videos, only over the pictures in the "
            f"report: {reason}"
        )
        return None


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
    from bodycap_batch.api import Execution
    from bodycap_batch.pipeline import remake_report

    resolved = load_last_run(job, make_overrides(out, skeleton, height))
    out_dir = results_folder(resolved)
    with event_on_signal() as stop, make_progress_display(as_json=False) as display:
        settings = Execution(store=store, threads=threads, progress=display, cancelled=stop.is_set).settings(
            out_dir
        )
        path = remake_report(resolved, out_dir=out_dir, settings=settings)
    print_line(f"report: {path}")


_MAX_SHIFT_S = 86_400.0
"""Longest shift that is accepted, seconds: a day. Evidence: none."""


@app.command(short_help="Show two motions side by side on a page.")
def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="A results folder or a BVH file.")],
    second: Annotated[
        Path, typer.Argument(metavar="B", help="A results folder, a BVH file, or a truth as joints.npz.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE.html", help="The page to write.")] = Path(
        "comparison.html"
    ),
    shift: Annotated[
        float,
        typer.Option(
            min=-_MAX_SHIFT_S, max=_MAX_SHIFT_S, metavar="SECONDS", help="Time to add to the times of B."
        ),
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Compare two motions: two takes, or a result and the true motion.

    The page shows joint angles, foot contacts, floor clearance and paths of both motions over each other.
    Both motions start at time 0 unless --shift is given.

    \b
    Examples:
      bodycap compare out/monday out/tuesday
      bodycap compare out/my_walk mocap.bvh --shift 0.4 --out walk.html
      bodycap compare out/my_walk capture/gt/joints.npz
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.report.comparison import compare as compare_motions
    from bodycap_batch.report.comparison import write_comparison

    found = compare_motions(first, second, shift)
    write_comparison(found, out)
    if as_json:
        print_json({**found.figures, "page": str(out)})
        return
    for name, each in found.figures["angles"].items():
        print_line(f"{name:16} A and B differ by {each['mean_abs_deg']:5.1f}° on average")
    print_line(f"page: {out}")
