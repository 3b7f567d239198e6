"""Options and arguments that several commands share."""

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
        help=f"Folder for the results of finished stages, which the next run reuses (default: {default}).",
        envvar=STORE_VARIABLE,
        show_envvar=True,
    )


JobArgument = Annotated[
    Path,
    typer.Argument(
        metavar="JOB_OR_FOLDER",
        help="A job file (YAML), a folder of videos, or a folder of results. If a folder of videos contains "
        "a job.yaml, this file is used.",
        readable=False,  # typer does not check this: the job loader gives a better message, with advice
    ),
]
OutOption = Annotated[Path | None, _out("Folder for the results (default: out/<name> beside the job).")]
BatchOutOption = Annotated[
    Path | None,
    _out("Folder that contains the results folder of each job (default: the folder out beside each job)."),
]
SkeletonOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE.bvh", help="Skeleton: none, upper_body, full_body, or the subject's own BVH file."
    ),
]
HeightOption = Annotated[
    float | None, typer.Option("--height", metavar="METRES", help="Height of the subject, for example 1.75.")
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(min=1, max=1024, help="Number of cores to use (default: all).", show_default=False),
]
MemoryOption = Annotated[
    int | None,
    typer.Option(
        "--memory-mb",
        min=500,
        max=1 << 24,
        metavar="MB",
        help="Memory limit of one task (default: four fifths of the machine's memory).",
        show_default=False,
    ),
]
StoreOption = Annotated[Path | None, _store("the one that the results name, else .store beside them")]
WatchStoreOption = Annotated[Path | None, _store(".store beside INBOX")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def results_folder(job: Job) -> Path:
    """Return the results folder of a loaded job."""
    assert job.out is not None  # the loader gives every job a folder
    return job.out
