"""`bodycap why` and `bodycap gc`: explain which stages a job would run, and remove unused artefacts."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import (
    STORE_VARIABLE,
    ActivityOption,
    CamerasOption,
    HeightOption,
    JobArgument,
    JsonOption,
    OutOption,
    PlacesOption,
    SkeletonOption,
    StoreOption,
    make_overrides,
    results_folder,
)
from bodycap_batch.cli.terminal import print_json, print_line, print_lines, table_lines
from bodycap_batch.core.errors import StoreError
from bodycap_batch.job_places import find_job, find_store, is_store


@app.command()
def why(  # noqa: PLR0913, PLR0917 - the flags a user types
    job: JobArgument,
    out: OutOption = None,
    skeleton: SkeletonOption = None,
    height: HeightOption = None,
    camera: CamerasOption = None,
    places: PlacesOption = None,
    activity: ActivityOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show which stages of a job would run, and why.

    A stage runs if its options, its inputs, the program or a library have changed since the last run. Nothing
    is computed.

    \b
    Example:
      bodycap why my_walk/ --height 1.75
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.api import Execution
    from bodycap_batch.config.job import load_job
    from bodycap_batch.pipeline import explain_job

    place = find_job(job)
    resolved = load_job(
        place.file, make_overrides(out or place.results, skeleton, height, camera, activity, places)
    )
    out_dir = results_folder(resolved)
    steps = explain_job(
        resolved, out_dir=out_dir, settings=Execution(store=store, threads=1).settings(out_dir)
    )
    if as_json:
        print_json([step.to_dict() for step in steps], indent=1)
        return
    print_lines(
        table_lines(
            [(each.stage, "stored" if each.stored else f"would run: {each.reason}") for each in steps]
        )
    )
    if all(step.stored for step in steps):
        print_line("nothing to do")


@app.command()
def gc(
    store: Annotated[
        Path | None,
        typer.Argument(
            metavar="STORE",
            help="Folder of the store, a folder that holds it, a folder of results, a folder of videos or a "
            "job file (default: BODYCAP_STORE, else the store below the working folder).",
        ),
    ] = None,
    delete: Annotated[bool, typer.Option("--delete", help="Remove the artefacts that no job uses.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List the artefacts that no job uses, or remove them.

    A job means the store of its results, which other jobs may share. The artefacts of each job's last run
    stay in the store as long as the job's results folder exists. Results are never removed.

    \b
    Examples:
      bodycap gc my_walk/
      bodycap gc out/.store --delete
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.config.job import results_of_job
    from bodycap_batch.store.artefacts import Store
    from bodycap_batch.store.garbage_collection import collect_garbage

    folder = store or Path(os.environ.get(STORE_VARIABLE) or ".")
    results = find_job(folder).results
    nearby = [folder, find_store(results or folder), folder / ".store", folder / "out/.store"]
    if results is None:
        nearby.append(find_store(results_of_job(folder)))
    store_dir = next((place for place in nearby if is_store(place)), None)
    if store_dir is None:
        raise StoreError(
            "there is no store in this folder",
            path=folder.resolve(),
            hint="give the folder of the store, of results, or of a job that has run: bodycap gc FOLDER",
        )
    garbage = collect_garbage(Store(store_dir), delete=delete)
    if as_json:
        print_json({**asdict(garbage), "deleted": delete}, indent=1)
        return
    for name in (*garbage.artefacts, *(f"corrupt/{name}" for name in garbage.corrupt)):
        print_line(name)
    for owner in garbage.gone:
        print_line(f"these results no longer exist: {owner}")
    count, size = len(garbage.artefacts) + len(garbage.corrupt), f"{garbage.freed_bytes / 1e6:.1f} MB"
    verb = "removed" if delete else "would remove"
    print_line(
        f"{verb} {count} of {count + garbage.kept} artefacts, "
        f"{size}{'' if delete else ' (use --delete to remove these artefacts)'}"
    )
