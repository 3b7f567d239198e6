"""Options and arguments that several commands share, and the default folders for results and stores."""

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
        help="A job file (YAML), or a folder of videos. If the folder contains a job.yaml, this file is "
        "used.",
        readable=False,  # typer does not check this: the job loader gives a better message, with advice
    ),
]
OutOption = Annotated[Path | None, _out("Folder for the results (default: out/<job>).")]
BatchOutOption = Annotated[
    Path | None, _out("Folder that contains the results folder of each job (default: out).")
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
StoreOption = Annotated[Path | None, _store(".store beside the results")]
BatchStoreOption = Annotated[Path | None, _store(".store in the results folder")]
WatchStoreOption = Annotated[Path | None, _store(".store beside INBOX")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_out() -> Path:
    """Return the default parent folder of all results: ``out`` in the working folder."""
    return Path.cwd() / "out"


def results_folder(job: Job) -> Path:
    """Return the results folder of a job: the job's `out`, else the folder ``out/<name of the job>``."""
    return job.out or default_out() / job.name


def default_store(out_dir: Path) -> Path:
    """Return the default folder of the store that a results folder uses.

    All results folders in ``out/`` share the store ``out/.store``. Any other results folder has a separate
    store inside it.
    """
    shared = default_out()
    return (shared if out_dir in (shared, shared / out_dir.name) else out_dir) / ".store"
