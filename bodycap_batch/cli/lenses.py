"""`bodycap lenses`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import JsonOption
from bodycap_batch.cli.terminal import print_json, print_line

_MAX_LISTED = 200
"""Maximum number of profiles that the text lists."""


@app.command()
def lenses(
    search: Annotated[
        list[str],
        typer.Argument(metavar="SEARCH...", help="Words of the model, lens mode or size: hero11 wide 4k."),
    ],
    as_json: JsonOption = False,
) -> None:
    """Search the lenses that a job can name.

    A job names a lens as `calibration: GoPro HERO11 Black / Wide / 4K`. It is the first guess, which the map
    refines. The profiles are from Gyroflow's collection (CC0).

    \b
    Example:
      bodycap lenses hero11 wide 4k
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.lens_profiles import search_lenses
    from bodycap_batch.core.errors import JobError

    words = " ".join(search)
    found = search_lenses(words)
    if not found:
        raise JobError(
            f"there is no lens profile with the words {words!r}",
            hint="search with fewer words, for example the model alone",
        )
    if as_json:
        print_json([{"name": each.name, **asdict(each)} for each in found], indent=1)
        return
    for profile in found[:_MAX_LISTED]:
        print_line(profile.text())
    if len(found) > _MAX_LISTED:
        print_line(f"and {len(found) - _MAX_LISTED} more: search with more words")
