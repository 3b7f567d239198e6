"""A first job file for a folder of videos: what was found, what to fill in, every option explained."""

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

from bodycap_batch.capture.indexing import index_video
from bodycap_batch.config.folder import recordings_in
from bodycap_batch.config.models import Job
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.atomic_files import write_text

JOB_FILE = "job.yaml"
UNKNOWN_MOUNT = "<where on the body?>"
_STAGES = ("keyframes", "map", "registration", "merge", "export")
_OPTION_WIDTH = 34
_MAX_NAME_LENGTH = 60
"""A camera's name may have 64 characters, and a number may follow."""


def write_job_template(folder: Path, *, replace: bool = False) -> Path:
    """Write ``job.yaml`` for the videos found in a folder.

    Args:
        folder: Holds videos, folders of chapters, perhaps ``calib.json`` and a skeleton (``*.bvh``).
        replace: Overwrite a job file that is there.

    Returns:
        The file.

    Raises:
        JobError: There is a job file already.
        CaptureError: There are no videos, or one cannot be opened.
        StoreError: The file cannot be written.
    """
    path = folder / JOB_FILE
    if path.exists() and not replace:
        raise JobError("there is a job file already", path=path, hint="--force writes a new one over it")
    write_text(path, job_template(folder))
    return path


def job_template(folder: Path) -> str:
    """The text of such a file. Raises as `write_job_template`, but for what is there already."""
    recordings = recordings_in(folder)
    lines = [
        "# A job for bodycap. Paths are relative to this file; lines that begin with # are off.",
        "#   bodycap check job.yaml    says what would be used, and what is wrong with it",
        "#   bodycap run job.yaml      computes it",
        "",
        f"name: {_yaml_text(_safe_name(folder.resolve().name))}",
        "",
        *_body_lines(folder),
        "",
        "capture:",
        *_calibration_lines(folder),
        "  # The stretch to use, in seconds on the common clock: cuts off the strapping-on.",
        "  # start_s: 12.0",
        "  # end_s: 95.5",
        *(_mount_lines() if any(mount_of(name) is None for name, _ in recordings) else ()),
        "  cameras:",
    ]
    for safe, (name, files) in zip(_unique_names([name for name, _ in recordings]), recordings, strict=True):
        lines += _camera_lines(safe, name, files, folder)
    lines += [
        "",
        "# What follows are the defaults of every stage: change what you need, leave the rest.",
        *_option_lines(),
    ]
    return "\n".join(lines) + "\n"


def _body_lines(folder: Path) -> list[str]:
    rigs = sorted(path.name for path in folder.glob("*.bvh"))
    lines = [
        "# Who was filmed. The height gives the metric scale; the subject's own skeleton gives it better."
    ]
    if rigs:
        lines += [f"skeleton: {_yaml_text(rigs[0])}", "# height_m: 1.75"]
    else:
        lines += [
            "# height_m: 1.75",
            "# skeleton: subject.bvh     # or none: only the map and the cameras' paths",
        ]
    return [*lines, "# activity: walk             # walking's soft rules; default generic"]


def _calibration_lines(folder: Path) -> list[str]:
    if (folder / "calib.json").is_file():
        return ["  calibration: calib.json"]
    return [
        "  # The lens is guessed and refined while mapping. Better: film a board, then",
        "  #   bodycap calibrate board.mp4 --charuco 7x5 --out calib.json",
        "  calibration: auto            # or calib.json",
    ]


def _mount_lines() -> list[str]:
    """What a mount can be called, for those whose file's name does not say."""
    listed = textwrap.wrap(", ".join(MOUNT_NAMES), 90)
    return ["  # Where a camera can be worn (`mount:`):", *(f"  #   {line}" for line in listed)]


def _camera_lines(safe: str, name: str, files: Sequence[Path], folder: Path) -> list[str]:
    paths = [path.relative_to(folder).as_posix() for path in files]
    video = _yaml_text(paths[0]) if len(paths) == 1 else f"[{', '.join(map(_yaml_text, paths))}]"
    lines = [f"    # {_video_summary(files)}", f"    - name: {_yaml_text(safe)}", f"      video: {video}"]
    found = mount_of(name)
    if found is None or mount_of(safe) != found:
        lines.append(f"      mount: {_yaml_text(UNKNOWN_MOUNT if found is None else found[0])}")
    if not list(folder.glob(f"{name}.timestamps.txt")):
        lines.append("      # offset_s: 0.0          # common time = camera time + offset_s: from the clap")
    return lines


def _video_summary(files: Sequence[Path]) -> str:
    """What the files of one camera are, in a line."""
    if files[0].is_dir():
        return f"chapters in {files[0].name}/"
    videos = [index_video(path) for path in files]
    width, height = videos[0].shown_size
    seconds = sum(float((int(each.pts[-1]) - int(each.pts[0])) * each.time_base) for each in videos)
    chapters = f", {len(files)} chapters" if len(files) > 1 else ""
    return f"{width}×{height}, {videos[0].fps:.4g} fps, {seconds:.1f} s{chapters}"


def _option_lines() -> Iterable[str]:
    """All options with their defaults and meanings, switched off."""
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
    """The words an option takes, where it takes words of a list."""
    if typing.get_origin(annotation) is Literal:
        return "one of " + ", ".join(map(str, typing.get_args(annotation)))
    inner = [words for argument in typing.get_args(annotation) if (words := _choices_text(argument))]
    return inner[0].replace("one of", "any of") if inner and typing.get_origin(annotation) is tuple else ""


def _default_text(field: FieldInfo) -> str:
    value: Any = field.get_default(call_default_factory=True)
    return json.dumps(value, ensure_ascii=False)


def _yaml_text(text: str) -> str:
    """Text as a YAML value: quoted where YAML would take it for something else."""
    plain = re.fullmatch(r"[A-Za-z][\w./\-]*", text) and text.lower() not in {"null", "true", "false"}
    return text if plain else json.dumps(text, ensure_ascii=False)


def _unique_names(found: Sequence[str]) -> list[str]:
    """A name for each camera, none of them twice: "cam 1" and "cam_1" would be one folder of results."""
    out: list[str] = []
    taken: set[str] = set()
    for plain in map(_safe_name, found):
        name, number = plain, 2
        while name.lower() in taken:
            name, number = f"{plain}_{number}", number + 1
        taken.add(name.lower())
        out.append(name)
    return out


def _safe_name(text: str) -> str:
    """A name that the results' files can carry."""
    return re.sub(r"[^A-Za-z0-9_\-]+", "_", text).strip("_-")[:_MAX_NAME_LENGTH] or "walk"
