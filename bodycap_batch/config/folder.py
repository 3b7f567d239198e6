"""Use a folder of videos as a capture: the file names give the names of the cameras."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from bodycap_batch.config.mounts import MOTION_PLACES, PLACES_TEXT, mount_of
from bodycap_batch.core.errors import CaptureError, JobError

VIDEO_SUFFIXES = frozenset(
    {
        ".mp4",
        ".mov",
        ".m4v",
        ".avi",
        ".mkv",
        ".webm",
        ".mts",
        ".m2ts",
        ".ts",
        ".mpg",
        ".mpeg",
        ".insv",
        ".360",
        ".3gp",
        ".wmv",
    }
)
PHOTO_SUFFIXES = frozenset(
    {
        ".jpg",
        ".jpeg",
        ".png",
        ".heic",
        ".heif",
        ".gif",
        ".webp",
        ".tif",
        ".tiff",
        ".bmp",
        ".dng",
        ".gpr",
        ".raw",
    }
)
ARCHIVE_SUFFIXES = frozenset({".zip", ".rar", ".7z", ".tar", ".gz", ".tgz", ".xz", ".bz2"})
JOB_FILES = ("job.yaml", "job.yml")
"""File names that the job file of a folder may have."""
CALIBRATION_FILE = "calib.json"
"""Name of the file with the calibration of the cameras in a folder of videos."""
RUN_FILE = "run.json"
"""Name of the file that records a run. A folder with this file holds results. A ``job.yaml`` in such a folder
belongs to the results; it is not a job to run."""
PARTIAL = "partial"
"""Name of the subfolder for the results of a job that did not finish. The subfolder holds the results without
the skeleton that the job asks for, or only the report of a job without results."""
_SYSTEM_MARKS = (".", "@", "#", "$")
"""First characters of the names of folders that a system keeps for itself: hidden folders, and folders of
network storage (@eaDir, #recycle) and of Windows ($RECYCLE.BIN)."""
Recording = tuple[str, tuple[Path, ...]]
"""The name of a recording, and its videos in order."""
_GOPRO = re.compile(r"^(G[HXPSLOT])(PR|[0-9]{2})([0-9]{4})$", re.IGNORECASE)


def natural_key(path: Path) -> tuple[tuple[int, int | str], ...]:
    """Return a sort key for the chapters of a video; it sorts numbers in the names by their value.

    Names of GoPro files are sorted by video, then by chapter. ``GX020123`` is chapter 2 of video 0123. On
    older GoPros, the first chapter of video 0123 is ``GOPR0123`` and the second chapter is ``GP010123``.
    """
    gopro = _GOPRO.match(path.stem)
    if gopro:
        chapter = 0 if gopro.group(2).upper() == "PR" else int(gopro.group(2))
        return ((0, int(gopro.group(3))), (0, chapter))
    parts = re.split(r"([0-9]+)", path.stem.lower())
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts if part)


def is_video(path: Path) -> bool:
    """Return True if the path is a visible (not hidden) file with the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".") and path.is_file()


def chapters_in(folder: Path) -> tuple[Path, ...]:
    """Return the videos in a camera's folder, in the order in which they were recorded.

    Raises:
        CaptureError: The folder holds no video, or it cannot be read.
    """
    try:
        chapters = sorted((path for path in folder.iterdir() if is_video(path)), key=natural_key)
    except OSError as error:
        raise CaptureError(
            f"the folder cannot be read ({error})", path=folder, hint="correct the path"
        ) from error
    if not chapters:
        raise CaptureError(
            "the folder of this camera contains no video",
            path=folder,
            hint=f"give a folder that contains videos, which end with {', '.join(sorted(VIDEO_SUFFIXES))}",
        )
    return tuple(chapters)


def videos_in(folder: Path) -> list[Path]:
    """Return the video files and the folders of chapters in a folder, sorted by name.

    Folders of results are ignored.

    Raises:
        CaptureError: The folder holds no video, or it cannot be read.
    """
    try:
        entries = visible_entries(folder)
        videos = [path for path in entries if is_video(path) or (path.is_dir() and has_chapters(path))]
    except OSError as error:
        raise CaptureError(
            f"the folder cannot be read ({error})", path=folder, hint="correct the path"
        ) from error
    if not videos:
        raise CaptureError(
            f"the folder contains no video{_content_instead(entries)}",
            path=folder,
            hint=f"{_first_step(entries)}put the videos into the folder, and name each video after its place "
            "on the body, for example torso.mp4, left_palm.mp4, right_palm.mp4",
        )
    return videos


def _content_instead(entries: Sequence[Path]) -> str:
    """Return what a folder without videos contains, as the end of a sentence; "" if it is not known."""
    kinds = (("photos", PHOTO_SUFFIXES), ("an archive", ARCHIVE_SUFFIXES))
    found = [name for name, suffixes in kinds if any(path.suffix.lower() in suffixes for path in entries)]
    try:
        inner = {path.name: readable_entries(path) for path in entries if path.is_dir()}
        deeper = [
            name
            for name, paths in inner.items()
            if any(is_video(video) for path in paths if path.is_dir() for video in readable_entries(path))
        ]
    except OSError:
        deeper = []
    found += [f"the folder {name} with folders of videos" for name in deeper[:1]]
    return f"; it contains {' and '.join(found)}" if found else ""


def _first_step(entries: Sequence[Path]) -> str:
    """Return the advice to unpack an archive in a folder, as the start of a hint; "" without an archive."""
    has_archive = any(path.suffix.lower() in ARCHIVE_SUFFIXES for path in entries)
    return "unpack the archive; " if has_archive else ""


def readable_entries(folder: Path) -> list[Path]:
    """Return the entries of a folder, sorted; none if it may not be read, which is reported where it is used.

    Raises:
        OSError: The disk fails.
    """
    return sorted(folder.iterdir()) if os.access(folder, os.R_OK | os.X_OK) else []


def real_path(path: Path) -> Path:
    """Return the absolute path without symbolic links; for a path that cannot be followed, with them."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):  # a loop of links, a name that is too long, a null character
        return path.absolute()


def shown_name(path: Path) -> str:
    """Return a path as text for the user. Bytes that are not UTF-8 are replaced."""
    return path.as_posix().encode(errors="backslashreplace").decode()


def visible_entries(folder: Path) -> list[Path]:
    """Return the files and folders in a folder that are not hidden, sorted by name.

    Folders that a system keeps for itself are omitted, unless they have the name of a place on the body.
    """
    return sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".")
        and not (is_system_folder(path.name) and path.is_dir() and mount_of(path.name) is None)
    )


def is_system_folder(name: str) -> bool:
    """Return True for the name of a folder that a system keeps for itself."""
    return name.startswith(_SYSTEM_MARKS)


def has_chapters(folder: Path) -> bool:
    """Return True if a folder holds videos, and no results."""
    return any(map(is_video, folder.iterdir())) and not (folder / RUN_FILE).is_file()


def recordings_in(folder: Path) -> list[Recording]:
    """Return the recordings in a folder: the name of each recording, and its videos in order.

    Raises:
        CaptureError: The folder holds no video, or a folder cannot be read.
    """
    return grouped_recordings(videos_in(folder))


def grouped_recordings(videos: Sequence[Path]) -> list[Recording]:
    """Group videos to recordings: a video file, a folder of chapters, or all chapters of one GoPro video.

    Several recordings can have the same name: ``torso.mp4`` and ``torso.mov``.
    """
    found: dict[tuple[str, str], list[Path]] = {}
    for path in videos:
        gopro = _gopro_name(path)
        key = (gopro, "chapters") if gopro else (recording_name(path), path.name)
        found.setdefault(key, []).append(path)
    return [(name, tuple(sorted(paths, key=natural_key))) for (name, _), paths in found.items()]


def _gopro_name(path: Path) -> str | None:
    """Return the name that all chapters of one GoPro video share; None for any other file or folder."""
    gopro = None if path.is_dir() else _GOPRO.match(path.stem)
    if gopro is None:
        return None
    kind = gopro.group(1).upper()
    return f"{'GO' if kind == 'GP' else kind}-{gopro.group(3)}"


def recording_name(path: Path) -> str:
    """Return the name of a video file or of a folder of chapters."""
    return path.name if path.is_dir() else path.stem


def job_file_in(folder: Path) -> Path | None:
    """Return the job file in a folder of videos; None if there is none, or if the folder holds results."""
    if (folder / RUN_FILE).is_file():
        return None
    return next((folder / name for name in JOB_FILES if (folder / name).is_file()), None)


def folder_capture(folder: Path, is_known: Callable[[str], bool]) -> dict[str, object]:
    """Return the raw ``capture`` block of a job for a folder of videos.

    Args:
        folder: The folder.
        is_known: Function that returns True if the place of a video on the body is known. Its argument is the
            name of the video.

    Raises:
        CaptureError: The folder holds no video, or it cannot be read.
        JobError: Two cameras have the same name. Or there are several cameras, and the name of one camera is
            not a known place on the body.
    """
    videos = videos_in(folder)
    _refuse_missing_videos(folder)
    _refuse_nested_videos(videos)
    named = [(recording_name(path), path) for path in videos]
    _refuse_equal_names(named)
    if len(named) > 1:
        _refuse_unknown_mounts(named, is_known)
    return {"cameras": [camera_block(name, path) for name, path in named]}


def camera_block(name: str, path: Path) -> dict[str, object]:
    """Return the raw block of a camera for a video or a folder of chapters."""
    return {
        "name": re.sub(r"[^A-Za-z0-9_\-]+", "_", name).strip("_-") or "camera",
        "video": str(path),
    }


def calibration_in(folder: Path) -> Path | None:
    """Return the calibration file in a folder; None if there is none.

    Raises:
        CaptureError: The file is a symbolic link that leads nowhere.
    """
    path = folder / CALIBRATION_FILE
    if path.is_symlink() and not path.exists():
        raise CaptureError("a link that leads nowhere", path=path, hint="link it again, or remove the link")
    return path if path.is_file() else None


def _refuse_missing_videos(folder: Path) -> None:
    """Refuse a folder in which the videos of a camera are missing.

    Without this check, the body would be solved without the camera. A video counts as missing if it is a
    broken symbolic link, or if a folder that has the name of a mount is empty.
    """
    for path in sorted(folder.iterdir()):
        if path.is_symlink() and not path.exists() and path.suffix.lower() in VIDEO_SUFFIXES:
            raise CaptureError(
                "this link leads to a file that does not exist",
                path=path,
                hint="correct the link, or replace the link by the video itself",
            )
        if path.is_dir() and mount_of(path.name) is not None and not (path / RUN_FILE).is_file():
            chapters_in(path)


def _refuse_nested_videos(videos: Sequence[Path]) -> None:
    """Refuse a folder with one subfolder that holds videos of different cameras.

    Without this check, these videos would be the chapters of one camera.
    """
    if len(videos) != 1 or not videos[0].is_dir() or mount_of(videos[0].name) is not None:
        return
    places = {found for path in chapters_in(videos[0]) if (found := mount_of(path.stem)) is not None}
    if len(places) > 1:
        raise JobError(
            f"the videos are in the subfolder {videos[0].name}",
            path=videos[0].parent,
            hint=f"give the subfolder: {shlex.quote(str(videos[0]))}",
        )


def _refuse_equal_names(named: list[tuple[str, Path]]) -> None:
    seen: dict[str, Path] = {}
    for name, path in named:
        if name.lower() in seen:
            raise JobError(
                f"two cameras would have the name {name!r}: {seen[name.lower()].name} and {path.name}",
                path=path.parent,
                hint="rename one of the two (cameras on one segment can have the names torso and "
                "torso_back); if both are chapters of one camera, put both into one folder",
            )
        seen[name.lower()] = path


def _refuse_unknown_mounts(named: list[tuple[str, Path]], is_known: Callable[[str], bool]) -> None:
    unknown = [(name, path) for name, path in named if not is_known(name)]
    if unknown:
        folder, first = named[0][1].parent, unknown[0][0]
        raise JobError(
            f"the place of {', '.join(path.name for _, path in unknown)} on the body is unknown, because the "
            "name does not contain a place",
            path=folder,
            hint=f"give the place of each video, for example --camera {first}=torso; or rename each video, "
            f"or the folder of its chapters, after its place (torso.mp4); {_motion_hint(named)}or run "
            f"`bodycap init {shlex.quote(folder.name)}`, which writes a job.yaml with a blank per place. "
            f"The places are {PLACES_TEXT}",
        )


def _motion_hint(named: Sequence[tuple[str, Path]]) -> str:
    """Return the advice to let the run find the places, for three cameras that can be at `MOTION_PLACES`."""
    stated = [found[0] for name, _ in named if (found := mount_of(name)) is not None]
    if len(named) != len(MOTION_PLACES) or not set(stated) <= set(MOTION_PLACES):
        return ""
    return f"if you do not know which is which, let the run find it: --places {','.join(MOTION_PLACES)}; "
