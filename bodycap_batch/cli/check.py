"""`bodycap check`, `init` and `doctor`: what to do before a job runs."""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import (
    ActivityOption,
    CamerasOption,
    HeightOption,
    JobArgument,
    JsonFindingsOption,
    OutOption,
    PlacesOption,
    SkeletonOption,
    make_overrides,
)
from bodycap_batch.cli.terminal import print_json, print_line, print_lines
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
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
    as_json: JsonFindingsOption = False,
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


@app.command(short_help="Check this machine: libraries, memory, disk, extras.")
def doctor(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results (default: out).")
    ] = Path("out"),
    as_json: JsonFindingsOption = False,
) -> None:
    """Check this machine: libraries, memory, disk, extras, Blender, a browser.

    The command loads every library in a separate process and tests the disk. The exit code is 5 if jobs
    will fail on this machine.

    \b
    Example:
      bodycap doctor
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.check.machine import examine_machine

    findings = []
    for finding in examine_machine(out):
        findings.append(finding)
        if not as_json:
            print_lines(finding.lines())
    problems = [finding.what for finding in findings if finding.state == "problem"]
    if as_json:
        print_json([dataclasses.asdict(finding) for finding in findings], indent=1)
    else:
        print_line(f"problems: {', '.join(problems)}" if problems else "this machine can run jobs")
    if problems:
        raise typer.Exit(StoreError.exit_code)
