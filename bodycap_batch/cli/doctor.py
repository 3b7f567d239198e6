"""`bodycap doctor`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.core.errors import StoreError


@app.command(short_help="Check this machine: libraries, memory, disk, extras.")
def doctor(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where results will be written (default: out).")
    ] = Path("out"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Check this machine: libraries, memory, disk, extras, Blender, a browser.

    Loads every library in a process of its own and tries the disk. Exit code 5 where jobs will fail here.

    \b
    Example:
      bodycap doctor
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.check.machine import examine_machine

    looks = []
    for look in examine_machine(out):
        looks.append(look)
        if not as_json:
            typer.echo(look.line())
    problems = [look.what for look in looks if look.state == "problem"]
    if as_json:
        typer.echo(json.dumps([dataclasses.asdict(look) for look in looks], indent=1))
    else:
        typer.echo(f"not fit: {', '.join(problems)}" if problems else "fit to run jobs")
    if problems:
        raise typer.Exit(StoreError.exit_code)
