"""`bodycap check`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import (
    ActivityOption,
    CamerasOption,
    HeightOption,
    JobArgument,
    OutOption,
    PlacesOption,
    SkeletonOption,
    make_overrides,
)
from bodycap_batch.cli.terminal import print_json, print_lines
from bodycap_batch.job_places import find_job


@app.command()
def check(  # noqa: PLR0913, PLR0917 - the flags a user types
    job: JobArgument,
    out: OutOption = None,
    skeleton: SkeletonOption = None,
    height: HeightOption = None,
    camera: CamerasOption = None,
    places: PlacesOption = None,
    activity: ActivityOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Show the files and settings that a job uses, and its problems.

    Opens every video and prints which file belongs to which camera, where each setting comes from, and which
    files are not used. Checks calibration, mounts, clocks and disk space. Nothing is computed or written.

    \b
    Example:
      bodycap check my_walk/ --height 1.75
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.check import check_path
    from bodycap_batch.clocks import describe_clocks
    from bodycap_batch.config.models import NO_SKELETON
    from bodycap_batch.telemetry import telemetry_notes

    report = check_path(find_job(job).file, make_overrides(out, skeleton, height, camera, activity, places))
    if report.ready and report.job is not None:
        capture = report.job.capture
        clocks = describe_clocks(capture, with_body=report.job.skeleton != NO_SKELETON)
        notes = (*report.notes, *clocks, *telemetry_notes(capture))
        report = replace(report, notes=notes)
    if as_json:
        print_json(report.to_dict(), indent=1)
    else:
        print_lines(report.lines())
    raise typer.Exit(report.exit_code)
