"""Options and arguments that several commands share."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bodycap_batch.core.errors import JobError

if TYPE_CHECKING:
    from bodycap_batch.config.models import Job
    from bodycap_batch.config.overrides import Overrides

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
        metavar="NAME|FILE.bvh",
        help="Skeleton: auto, full_body, none, or the subject's own BVH file (default: auto).",
    ),
]
HeightOption = Annotated[
    str | None,
    typer.Option(
        "--height",
        metavar="HEIGHT",
        help="Height of the subject: in metres (1.75), centimetres (175), or feet and inches (5'9\"); none: "
        "the height of a mean adult (default: that of the last run).",
    ),
]
CamerasOption = Annotated[
    list[str] | None,
    typer.Option(
        "--camera",
        metavar="NAME=PLACE",
        help="Place on the body of a video whose name does not contain it, for example gopro1=torso. You can "
        "repeat this option.",
    ),
]
PlacesOption = Annotated[
    str | None,
    typer.Option(
        "--places",
        metavar="PLACE,PLACE,PLACE",
        help="Find from the motion which camera was where: torso,left_palm,right_palm. For videos whose "
        "names do not contain a place.",
    ),
]
ActivityOption = Annotated[
    str | None,
    typer.Option(metavar="walk|generic", help="What the subject does (default: generic; walk: only walks)."),
]
RequireOption = Annotated[
    str | None,
    typer.Option(
        metavar="GRADE[,SHARE]",
        help="Grade (good, usable, poor) and share of the recording that each result must reach, for example "
        "good,0.9. Otherwise the exit code is 6, after all results were written.",
    ),
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
JsonFindingsOption = Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")]
JsonProgressOption = Annotated[
    bool, typer.Option("--json-progress", help="Print progress as JSON lines on standard output.")
]


def make_overrides(
    out: Path | None = None,
    skeleton: str | None = None,
    height: str | None = None,
    cameras: list[str] | None = None,
    activity: str | None = None,
    places: str | None = None,
) -> Overrides:
    """Return the values of the command line that replace values of the job.

    Raises:
        JobError: The height, a camera or the activity cannot be understood.
    """
    from bodycap_batch.config.body_height import height_from_text
    from bodycap_batch.config.overrides import NO_HEIGHT, Overrides

    return Overrides(
        out=out,
        skeleton=skeleton,
        height_m=None if height is None else "none" if height == NO_HEIGHT else height_from_text(height),
        mounts=_mounts(cameras or []),
        activity=activity,
        places=tuple(word.strip() for word in (places or "").split(",") if word.strip()),
    )


def checked_requirement(text: str | None) -> str | None:
    """Return the requirement of the command line. Raises `JobError` if it cannot be understood."""
    from bodycap_batch.config.requirement import REQUIREMENT_HINT, valid_requirement

    try:
        return None if text is None else valid_requirement(text)
    except ValueError as error:
        message = str(error).partition("; ")[0]
        raise JobError(message, field="--require", hint=REQUIREMENT_HINT) from error


def _mounts(words: list[str]) -> dict[str, str]:
    hint = "write the name of the video and its place on the body, for example gopro1=torso"
    return dict(split_pair(text, form="NAME=PLACE", field="--camera", hint=hint) for text in words)


def split_pair(text: str, *, form: str, field: str, hint: str) -> tuple[str, str]:
    """Return the two parts of a value of the command line that has a form such as NAME=PLACE.

    Raises:
        JobError: A part is missing.
    """
    name, equals, value = text.rpartition("=")
    if not (name and equals and value):
        raise JobError(f"{text[:60]!r} does not have the form {form}", field=field, hint=hint)
    return name.strip(), value.strip()


def parse_size(text: str, field: str, what: str, hint: str) -> tuple[int, int]:
    """Return the two numbers of a size such as 640x480. Raises `JobError` if it has another form."""
    found = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text.strip())
    if found is None:
        raise JobError(f"{text!r} is not {what}", field=field, hint=hint)
    return int(found[1]), int(found[2])


def results_folder(job: Job) -> Path:
    """Return the results folder of a loaded job."""
    assert job.out is not None  # the loader gives every job a folder
    return job.out
