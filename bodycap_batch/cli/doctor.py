"""`bodycap doctor`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.terminal import print_json, print_line, print_lines
from bodycap_batch.core.errors import StoreError


@app.command(short_help="Check this machine: libraries, memory, disk, extras.")
def doctor(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results (default: out).")
    ] = Path("out"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
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
