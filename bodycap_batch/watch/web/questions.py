"""Ask what the videos of a folder do not say: the height of the person, and the places of the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from bodycap_batch.config.body_height import height_from_text
from bodycap_batch.config.folder import JOB_FILES, VIDEO_SUFFIXES, camera_block, grouped_recordings
from bodycap_batch.config.mounts import MOTION_PLACES, MOUNT_NAMES, mount_of
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import decode_text
from bodycap_batch.store.artefacts import disk_errors

_FIRST_LINE = "# Written by the live page from the answers of the user."
"""First line of a job file with answers. Only such a file is replaced by new answers."""


def questions_about(names: Sequence[str]) -> dict[str, Any]:
    """Return what the page asks about a folder.

    Args:
        names: Paths of the folder's files, relative to the folder.

    Returns:
        A dictionary of JSON values: ``unknown``, the recordings whose names do not contain a place on the
        body, each with its name and its video files; ``places``, the possible places; ``found_places``, the
        places that the run can find from the motion instead, or an empty list; ``has_job``, True if a job
        file answers all questions.
    """
    recordings = _recordings(names)
    unknown = [name for name in recordings if mount_of(name) is None] if len(recordings) > 1 else []
    stated = {found[0] for name in recordings if (found := mount_of(name)) is not None}
    can_find = bool(unknown) and len(recordings) == len(MOTION_PLACES) and stated <= set(MOTION_PLACES)
    return {
        "found_places": list(MOTION_PLACES) if can_find else [],
        "unknown": [{"name": name, "files": recordings[name]} for name in unknown],
        "places": list(MOUNT_NAMES),
        "has_job": any(name in JOB_FILES for name in names),
    }


def files_below(folder: Path) -> list[str]:
    """Return the paths of the visible files in a folder and in its subfolders, relative to the folder."""
    found = [*folder.glob("*"), *folder.glob("*/*")]
    names = (path.relative_to(folder) for path in sorted(found) if path.is_file())
    return [name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts)]


def is_answered_by_page(folder: Path) -> bool:
    """Return True if a folder has no job file, or only one that the page has written."""
    found = [folder / name for name in JOB_FILES if (folder / name).is_file()]
    return all(decode_text(path.read_bytes(), "replace").startswith(_FIRST_LINE) for path in found)


def earlier_answers(folder: Path) -> dict[str, Any]:
    """Return what the page has written into the job file of a folder; empty without such a file.

    Returns:
        A dictionary of JSON values: ``height``, as text, and ``find_places``, True if a run was to find the
        places from the motion.
    """
    path = folder / JOB_FILES[0]
    if not path.is_file() or not is_answered_by_page(folder):
        return {}
    document = yaml.safe_load(decode_text(path.read_bytes(), "replace")) or {}
    capture = document.get("capture") or {}
    return {"height": str(document.get("height_m") or ""), "find_places": bool(capture.get("places"))}


def write_answers(folder: Path, answers: Mapping[str, Any]) -> None:
    """Write the answers of the user into the job file of a folder.

    Args:
        folder: The folder of videos.
        answers: ``height``, a text, which may be empty; ``places``, the place of each recording by its name;
            ``find_places``, True if the run shall find the places from the motion.

    Raises:
        JobError: An answer cannot be understood, or the user has put a job file into the folder.
        StoreError: The file cannot be written.
    """
    height, places = str(answers.get("height") or "").strip(), answers.get("places") or {}
    find_places = bool(answers.get("find_places"))
    if not height and not places and not find_places:
        return
    if not is_answered_by_page(folder):
        raise JobError(
            "the folder has a job file, which answers the questions",
            path=folder / JOB_FILES[0],
            hint="correct the job file",
        )
    document: dict[str, Any] = {"height_m": height_from_text(height)} if height else {}
    if find_places:
        recordings = _recordings(files_below(folder))
        unknown = {name: files for name, files in recordings.items() if mount_of(name) is None}
        cameras = [{"name": _camera_name(name), "video": files} for name, files in unknown.items()]
        document["capture"] = {"cameras": cameras, "places": list(MOTION_PLACES)}
    elif places:
        document["capture"] = {"cameras": _cameras(_recordings(files_below(folder)), places)}
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    with disk_errors(folder):
        (folder / JOB_FILES[0]).write_text(f"{_FIRST_LINE}\n{text}", encoding="utf-8")


def _cameras(recordings: Mapping[str, Sequence[str]], places: object) -> list[dict[str, Any]]:
    if not isinstance(places, Mapping):
        raise JobError("the places of the cameras are not given by name", hint="load the page again")
    cameras = []
    for name, place in places.items():
        if name not in recordings:
            raise JobError(f"there is no video {str(name)[:40]!r}", hint="load the page again")
        if mount_of(str(place)) is None:
            raise JobError(
                f"the place of {str(name)[:40]} on the body is not chosen",
                field="mount",
                hint=f"choose one of {', '.join(MOUNT_NAMES)}",
            )
        cameras.append({"name": _camera_name(name), "video": list(recordings[name]), "mount": str(place)})
    return cameras


def _camera_name(recording: str) -> str:
    return str(camera_block(recording, Path(recording))["name"])


def _recordings(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the videos of each recording, by the recording's name.

    A folder of chapters is one recording, as are all chapters of one GoPro video.
    """
    videos = [PurePosixPath(name) for name in names if PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES]
    found: dict[str, list[str]] = {}
    for path in videos:
        if len(path.parts) > 1:
            found.setdefault(path.parts[0], []).append(str(path))
    for name, paths in grouped_recordings([Path(path) for path in videos if len(path.parts) == 1]):
        found.setdefault(name, []).extend(str(path) for path in paths)
    return found
