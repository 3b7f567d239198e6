"""`bodycap sync`."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import JobArgument, JsonOption, results_folder
from bodycap_batch.cli.terminal import print_json, print_lines

if TYPE_CHECKING:
    from bodycap_batch.clocks import ClockEstimate, ClockEstimates


@app.command()
def sync(
    job: JobArgument,
    as_json: JsonOption = False,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE.svg", help="Draw the correlations and the offsets along time."),
    ] = None,
) -> None:
    """Find the clock offsets of the cameras from their sound.

    Prints the offset and the drift of each camera's clock relative to the torso's camera, and the lines for
    the job file. Where the sound does not decide, the clocks of the last run of the job are shown; the run
    estimates them from the motion. Nothing in the job is changed.

    \b
    Example:
      bodycap sync my_walk/ --picture clocks.svg
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.cli.pictures import draw_clocks
    from bodycap_batch.clocks import estimate_clocks
    from bodycap_batch.config.job import load_job
    from bodycap_batch.core.errors import JobError
    from bodycap_batch.formats.atomic_files import write_text

    loaded = load_job(job)
    capture = loaded.capture
    if len(capture.cameras) < 2:
        raise JobError(
            "there is only one camera: clocks are compared between cameras",
            path=job,
            hint="give a folder or a job with the videos of all cameras",
        )
    estimates = with_clocks_of_run(estimate_clocks(capture), results_folder(loaded))
    if picture is not None:
        write_text(picture, draw_clocks(estimates))
    _require_clocks(estimates, job)
    if as_json:
        print_json(clocks_as_json(estimates), indent=1)
    else:
        print_lines(lines_of(estimates))


def with_clocks_of_run(estimates: ClockEstimates, results: Path) -> ClockEstimates:
    """Return the clocks, completed by those that the last run of the job estimated from the motion.

    Args:
        estimates: The clocks that were estimated from the sound.
        results: Folder of the results of the job. It may be missing.
    """
    try:
        stored = json.loads((results / "metrics.json").read_bytes())["clocks"]
    except (OSError, ValueError, KeyError, TypeError):
        stored = {}

    def completed(clock: ClockEstimate) -> ClockEstimate:
        if clock.is_known:
            return clock
        found, values, reason = stored.get(clock.camera, {}), {}, "needs a run, which compares the motion"
        if found.get("source") == "motion":
            values, reason = {key: found[key] for key in _KEYS}, "from the last run of the job"
        return replace(clock, **values, reasons=(*clock.reasons, reason))

    return replace(estimates, cameras=tuple(map(completed, estimates.cameras)))


_KEYS = ("offset_s", "sigma_s", "drift_ppm", "drift_sigma_ppm", "source")
"""Keys of a clock in ``metrics.json`` and in the JSON output."""


def _values(clock: ClockEstimate) -> dict[str, object]:
    values = {key: getattr(clock, key) for key in _KEYS}
    return values if clock.is_known else {**values, "offset_s": None, "sigma_s": None}


def clocks_as_json(estimates: ClockEstimates) -> dict[str, object]:
    """Return the clocks as plain JSON values."""
    return {
        "reference": estimates.reference,
        "clocks": {clock.camera: _values(clock) for clock in estimates.cameras},
        "contradictions": {clock.camera: list(clock.notes) for clock in estimates.cameras},
        "reasons": {clock.camera: list(clock.reasons) for clock in estimates.cameras},
    }


def lines_of(estimates: ClockEstimates) -> Iterator[str]:
    """Yield the table of the clocks, what contradicts them, and the lines for the job file."""
    width = max(6, *(len(clock.camera) for clock in estimates.cameras))
    yield f"common time = time of {estimates.reference} = camera time · (1 + drift) + offset"
    yield f"{'camera':{width}}  {'offset':>12}  {'sigma':>9}  {'drift':>16}  source"
    for clock in estimates.cameras:
        yield f"{clock.camera:{width}}  {_figures(clock)}  {clock.source}"
    for clock in estimates.cameras:
        for kind, texts in (("contradiction", clock.notes), ("note", clock.reasons)):
            for text in texts:
                mark = f"{kind}: {clock.camera}: "
                yield from textwrap.wrap(text, 100, initial_indent=mark, subsequent_indent="  ")
    from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES

    found = [clock for clock in estimates.cameras if clock.source in ESTIMATED_SOURCES]
    if found:
        yield "for the cameras in job.yaml:"
        for clock in found:
            yield f"    - name: {clock.camera}"
            yield f"      offset_s: {clock.offset_s:.4f}"


def _figures(clock: ClockEstimate) -> str:
    if not clock.is_known:
        return f"{'unknown':>12}  {'':>9}  {'':>16}"
    drift = f"{clock.drift_ppm:+.1f} ± {clock.drift_sigma_ppm:.1f} ppm" if clock.sigma_s else ""
    sigma = f"{1e3 * clock.sigma_s:.1f} ms" if clock.sigma_s else ""
    return f"{clock.offset_s:+10.4f} s  {sigma:>9}  {drift:>16}"


def _require_clocks(estimates: ClockEstimates, job: Path) -> None:
    """Raise an error if the sound gives the clock of no camera."""
    from bodycap_batch.core.errors import EstimationError
    from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES

    others = [clock for clock in estimates.cameras if clock.camera != estimates.reference]
    if any(clock.source in (*ESTIMATED_SOURCES, "common") for clock in others):
        return
    reasons = "; ".join(f"{clock.camera}: {', '.join(clock.reasons)}" for clock in others)
    raise EstimationError(
        f"the sound of no camera agrees with that of {estimates.reference} ({reasons})",
        path=job,
        hint="check that all videos are of the same recording and have sound; otherwise clap once in view of "
        "all cameras and state offset_s",
    )
