"""The table of the real captures: ``python -m tests.bench real --real DIR --work DIR``.

No picture of these captures may enter the repository. Jobs run with ``--skeleton none``. A further call
continues where the last one stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from tests.bench.paired import tables
from tests.bench.paired.captures import chosen, folder_captures
from tests.bench.paired.command import add_run_options, run_settings, write_line
from tests.bench.paired.runs import run
from tests.bench.paired.sides import make_side

DAILY = (
    "dexumi_cube",
    "dexwild_green",
    "egodex_usb2",
    "egohomes_milk1",
    "egolife_kitchen",
    "eth_shelf",
    "gopro_max",
    "hawor_kitchen",
    "visualsync_lego",
    "visualsync_tag",
)
"""Short captures of unlike kinds for a run of at most 40 minutes on two cores: camera on the wrist, on the
body, on the head with truth and without, of few lines and of many, a phone, an action camera, a fisheye, and
several people. Evidence: docs/decisions/bench.md, real."""


def main(arguments: Sequence[str]) -> int:
    """Run the real captures and print their table; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench real", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="captures (default: all)")
    parser.add_argument("--daily", action="store_true", help="only short captures of unlike kinds")
    parser.add_argument("--commit", default=".", help="version that runs (default: the working tree)")
    parser.add_argument("--json", action="store_true", help="print the records as JSON")
    add_run_options(parser)
    options = parser.parse_args(arguments)
    if options.real is None or not options.real.is_dir():
        write_line(f"real captures: {options.real or 'no --real DIR given'}, skipped")
        return 0
    captures = folder_captures(options.real.resolve(), has_body=False)
    if options.daily:
        captures = [capture for capture in captures if capture.name in DAILY]
    settings = run_settings(options)
    side = make_side(options.commit, settings.work)
    records = []
    for capture in chosen(captures, options.names):
        records.append(run(side, capture, 0, settings))
        if not options.json:
            write_line(tables.text_table(tables.run_cells(records[-1]), ())[0])
    if options.json:
        write_line(json.dumps([asdict(record) for record in records], indent=1))
    else:
        write_line("")
        for line in tables.run_table(records):
            write_line(line)
    return 0
