"""Options and arguments that several commands share, and the folders that they stand for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from bodycap_batch.config.models import Job

STORE_VARIABLE = "BODYCAP_STORE"


def _out(what: str) -> Any:
    return typer.Option("--out", metavar="DIR", help=what)


def _store(default: str) -> Any:
    return typer.Option(
        "--store",
        metavar="DIR",
        help=f"Where finished stages are kept for the next run (default: {default}).",
        envvar=STORE_VARIABLE,
        show_envvar=True,
    )


JobArgument = Annotated[
    Path,
    typer.Argument(
        metavar="JOB_OR_FOLDER",
        help="A job file (YAML), or a folder of videos (its job.yaml decides, if it has one).",
        readable=False,  # the loader says it better, with the remedy
    ),
]
OutOption = Annotated[Path | None, _out("Folder for the results (default: out/<job>).")]
BatchOutOption = Annotated[Path | None, _out("Folder for the jobs' folders of results (default: out).")]
SkeletonOption = Annotated[
    str | None,
    typer.Option(metavar="NAME|FILE.bvh", help="none, upper_body, full_body, or the subject's own BVH file."),
]
HeightOption = Annotated[
    float | None, typer.Option("--height", metavar="METRES", help="The subject's height, e.g. 1.75.")
]
ThreadsOption = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Cores to keep busy (default: all).", show_default=False)
]
StoreOption = Annotated[Path | None, _store(".store beside the results")]
BatchStoreOption = Annotated[Path | None, _store(".store in the folder of results")]
WatchStoreOption = Annotated[Path | None, _store(".store beside INBOX")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print it as JSON.")]


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_out() -> Path:
    """Folder of all results that are not put elsewhere."""
    return Path.cwd() / "out"


def results_folder(job: Job) -> Path:
    """Where a job's results go."""
    return job.out or default_out() / job.name


def default_store(out_dir: Path) -> Path:
    """One store for all of ``out/``; results put elsewhere have their own."""
    shared = default_out()
    return (shared if out_dir in (shared, shared / out_dir.name) else out_dir) / ".store"
