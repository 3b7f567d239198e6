"""`bodycap compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import JsonOption
from bodycap_batch.cli.terminal import print_json, print_line

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
