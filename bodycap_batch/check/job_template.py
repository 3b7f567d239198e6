"""Write a first job file for a folder of videos.

The file lists the cameras in the folder, marks what the user must fill in, and explains every option.
"""

from __future__ import annotations

import json
import re
import textwrap
import typing
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.config.folder import recordings_in
from bodycap_batch.config.models import Job
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of
from bodycap_batch.config.rules import UNKNOWN_MOUNT
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.atomic_files import write_text

JOB_FILE = "job.yaml"
_STAGES = ("keyframes", "map", "registration", "merge", "export")
_OPTION_WIDTH = 34
"""Number of characters in the column of options, before the column of their meanings."""
_MAX_NAME_LENGTH = 60
"""Maximum number of characters in a name that is made from a file name.

A camera name in a job may have 64 characters. A number may be appended to the name.
"""


def write_job_template(folder: Path, *, replace: bool = False) -> Path:
    """Write ``job.yaml`` for the videos of a folder.

    Args:
        folder: Folder with videos or with folders of chapters. It may also contain a calibration
            (``calib.json``) and a skeleton (``*.bvh``).
        replace: True to overwrite an existing job file.

    Returns:
        The path of the job file.

    Raises:
        JobError: A job file exists already.
        CaptureError: There are no videos, or a video cannot be opened.
        StoreError: The file cannot be written.
    """
    path = folder / JOB_FILE
    if path.exists() and not replace:
        raise JobError(
            "the folder already contains a job file", path=path, hint="use --force to overwrite the file"
        )
    write_text(path, job_template(folder))
    return path


def job_template(folder: Path) -> str:
    """Return the text of a job file for the videos of a folder.

    Raises:
        CaptureError: There are no videos, or a video cannot be opened.
    """
    recordings = recordings_in(folder)
    lines = [
        "# A job for bodycap. Paths are relative to this file. Lines that begin with # have no effect.",
        "#   bodycap check job.yaml    shows which files and settings the job uses, and the problems of "
        "the job",
        "#   bodycap run job.yaml      computes the results",
        "",
        f"name: {_yaml_text(_safe_name(folder.resolve().name))}",
        "",
        *_body_lines(folder),
        "",
        "capture:",
        *_calibration_lines(folder),
        "  # The part of the recording to use (seconds on the common clock). Leave out the time in which "
        "the cameras are put on.",
        "  # start_s: 12.0",
        "  # end_s: 95.5",
        *(_mount_lines() if any(mount_of(name) is None for name, _ in recordings) else ()),
        "  # Videos in this folder that are not listed here become cameras, too.",
        "  # cameras_only: true         # use the listed cameras only",
        "  cameras:",
    ]
    for safe, (name, files) in zip(_unique_names([name for name, _ in recordings]), recordings, strict=True):
        lines += _camera_lines(safe, name, files, folder)
    lines += [
        "",
        "# The options of every stage follow, with their defaults. To change an option, remove the # "
        "before it.",
        *_option_lines(),
    ]
    return "\n".join(lines) + "\n"


def _body_lines(folder: Path) -> list[str]:
    rigs = sorted(path.name for path in folder.glob("*.bvh"))
    lines = [
        "# The person who wears the cameras. The body height gives the metric scale; a file of the "
        "person's own skeleton gives a more accurate scale."
    ]
    if rigs:
        lines += [f"skeleton: {_yaml_text(rigs[0])}", "# height_m: 1.75"]
    else:
        lines += [
            "# height_m: 1.75",
            "# skeleton: subject.bvh     # write `skeleton: none` to compute only map and camera paths",
        ]
    return [
        *lines,
        "# activity: walk             # if the person only walks: the hands are expected below the "
        "shoulders, each hand on its own side; default: generic",
    ]


def _calibration_lines(folder: Path) -> list[str]:
    if (folder / "calib.json").is_file():
        return ["  calibration: calib.json"]
    return [
        "  # With auto, the lens is estimated together with the map. It is more accurate to film a board "
        "and to run",
        "  #   bodycap calibrate board.mp4 --charuco 7x5 --out calib.json",
        "  # The file calib.json in this folder is used as soon as it exists.",
        "  # calibration: auto          # always estimate the lens",
    ]


def _mount_lines() -> list[str]:
    """Return comment lines that list all possible mounts.

    The list helps the user to fill in a mount that the file name of a camera does not contain.
    """
    listed = textwrap.wrap(", ".join(MOUNT_NAMES), 90)
    return ["  # Places of a camera on the body (`mount:`):", *(f"  #   {line}" for line in listed)]


def _camera_lines(safe: str, name: str, files: Sequence[Path], folder: Path) -> list[str]:
    paths = [path.relative_to(folder).as_posix() for path in files]
    video = _yaml_text(paths[0]) if len(paths) == 1 else f"[{', '.join(map(_yaml_text, paths))}]"
    lines = [f"    # {_video_summary(files)}", f"    - name: {_yaml_text(safe)}", f"      video: {video}"]
    found = mount_of(name)
    if found is None or mount_of(safe) != found:
        lines.append(f"      mount: {_yaml_text(UNKNOWN_MOUNT if found is None else found[0])}")
    if not list(folder.glob(f"{name}.timestamps.txt")):
        lines.append("      # offset_s: auto         # or seconds: common time = camera time + offset_s")
    return lines


def _video_summary(files: Sequence[Path]) -> str:
    """Return one line that describes the video files of a camera."""
    if files[0].is_dir():
        return f"chapters in {files[0].name}/"
    videos = [index_video(path) for path in files]
    width, height = videos[0].shown_size
    seconds = sum(float((int(video.pts[-1]) - int(video.pts[0])) * video.time_base) for video in videos)
    chapters = f", {len(files)} chapters" if len(files) > 1 else ""
    return f"{width}×{height}, {videos[0].fps:.4g} fps, {seconds:.1f} s{chapters}"


def _option_lines() -> Iterable[str]:
    """Yield comment lines that list all options of all stages, with their defaults and meanings."""
    for stage in _STAGES:
        model = Job.model_fields[stage].annotation
        assert isinstance(model, type)
        assert issubclass(model, BaseModel)
        yield f"# {stage}:"
        for name, field in model.model_fields.items():
            setting = f"{name}: {_default_text(field)}"
            words = _choices_text(field.annotation)
            meaning = "# " + "; ".join(part for part in (field.description, words) if part)
            yield f"#   {setting:{_OPTION_WIDTH}}{meaning}".rstrip()


def _choices_text(annotation: Any) -> str:
    """Return the permitted words of an option; "" if any value is permitted."""
    if typing.get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(annotation)))
    inner = [words for argument in typing.get_args(annotation) if (words := _choices_text(argument))]
    return inner[0].replace("one of", "any of") if inner and typing.get_origin(annotation) is tuple else ""


def _default_text(field: FieldInfo) -> str:
    value: Any = field.get_default(call_default_factory=True)
    return json.dumps(value, ensure_ascii=False)


def _yaml_text(text: str) -> str:
    """Return text as a YAML value. It is quoted if YAML could read the text as another type."""
    plain = re.fullmatch(r"[A-Za-z][\w./\-]*", text) and text.lower() not in {"null", "true", "false"}
    return text if plain else json.dumps(text, ensure_ascii=False)


def _unique_names(found: Sequence[str]) -> list[str]:
    """Return a different safe name for each camera.

    A number is appended where necessary. For example, both "cam 1" and "cam_1" have the safe name "cam_1".
    """
    out: list[str] = []
    used_names: set[str] = set()
    for plain in map(_safe_name, found):
        name, number = plain, 2
        while name.lower() in used_names:
            name, number = f"{plain}_{number}", number + 1
        used_names.add(name.lower())
        out.append(name)
    return out


def _safe_name(text: str) -> str:
    """Return a name that can be part of the file names of results."""
    return re.sub(r"[^A-Za-z0-9_\-]+", "_", text).strip("_-")[:_MAX_NAME_LENGTH] or "walk"
