"""Recognise files that show that a video in a folder is not complete, by what they are.

Programs that copy files write under a name of their own until the copy is complete: torso.mp4.part,
.torso.mp4.Xy12ab, torso.mp4.crdownload. Such a file has the name of a video with something after it, or it
begins as a video and is cut. Other programs keep files of their own beside the videos: thumbnails,
attributes, indexes. Such a file is hidden, or lies in a folder of the system.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from bodycap_batch.config.folder import (
    PHOTO_SUFFIXES,
    RUN_FILE,
    VIDEO_SUFFIXES,
    is_system_folder,
    is_video,
    readable_entries,
    shown_name,
)
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.file_completeness import is_video_by_content, missing_part

_VIDEO_NAME = re.compile(rf"({'|'.join(map(re.escape, sorted(VIDEO_SUFFIXES)))})(?![0-9a-z])", re.IGNORECASE)
"""Pattern of the end of a video's name, which something may follow: ``.mp4`` in ``torso.mp4.part``."""
_SIDECAR_SUFFIXES = PHOTO_SUFFIXES | {
    ".bvh", ".csv", ".gcsv", ".gpx", ".html", ".json", ".log", ".md", ".md5", ".ply", ".sha1", ".sha256",
    ".sha512", ".srt", ".txt", ".vtt", ".xml", ".yaml", ".yml",
}  # fmt: skip
"""Suffixes of files that are no videos although their names may contain that of a video, for example
``torso.mp4.timestamps.txt``, or a checksum that stays when its video gets another name."""
_HINT = (
    "copy the video again, remove this file, or state `cameras_only: true` in a job.yaml that lists the "
    "cameras to use"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class UnfinishedFile:
    """A file that shows that a video, or another input of a job, is not complete.

    Attributes:
        path: Path of the file.
        name: Its name, relative to the folder.
        reason: What is not complete, as text for the user.
        lacks_video: True if the folder does not hold the video that this file is a copy of.
    """

    path: Path
    name: str
    reason: str
    lacks_video: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class _ParsedName:
    """What the name of a file says.

    Attributes:
        folder: The user's folder that holds the file, or that holds the folder of the system with the file.
        video: The name of the video that the name contains; "" if there is none, or if the file lies in a
            folder of the system that is not hidden. Copying programs use hidden folders only.
        is_longer: True if something follows the name of the video.
        is_system: True if the file is hidden, or lies in a folder of the system.
        is_sidecar: True if the suffix is that of a file that is no video.
    """

    folder: str
    video: str
    is_longer: bool
    is_system: bool
    is_sidecar: bool

    @property
    def is_video(self) -> bool:
        """True for a video that is a part of a capture."""
        return bool(self.video) and not self.is_longer and not self.is_system


def names_video(name: str) -> bool:
    """Return True if a name contains the name of a video, or if it is one."""
    return _VIDEO_NAME.search(name) is not None


def relevant_files(files: Iterable[tuple[Path, str]]) -> list[tuple[Path, str]]:
    """Return the files of a folder without those that a system keeps for itself.

    A hidden file is relevant only if it may be an unfinished copy of a video: if its name says so, or if it
    has the name of a video that is not there, begins as a video, and is cut.

    Args:
        files: The path and the name, relative to the folder, of each file.
    """
    return [(path, name) for path, name, _, _ in _relevant(files)]


def unfinished_files(files: Iterable[tuple[Path, str]]) -> Iterator[UnfinishedFile]:
    """Yield the files of a folder that show that an input of a job is not complete.

    Args:
        files: The path and the name, relative to the folder, of each file.
    """
    for path, name, parsed, has_video in _relevant(files):
        lacks_video = not (has_video or parsed.is_sidecar)
        if parsed.is_longer and lacks_video:
            reason = f"the video {shown_name(Path(parsed.video))} itself is not there yet"
            yield UnfinishedFile(path=path, name=name, reason=reason, lacks_video=True)
        elif part := missing_part(path, frozenset() if parsed.is_system else VIDEO_SUFFIXES):
            yield UnfinishedFile(path=path, name=name, reason=part.text, lacks_video=lacks_video)


def refuse_missing_cameras(folder: Path, listed: Collection[Path] = ()) -> None:
    """Refuse a folder with a file that should be the video of a camera, but is not used as one.

    Without this check, the result would lack this camera. Such a file is an unfinished copy of a video that
    is not there, or a video that has the name of a place on the body, but not the suffix of a video. Folders
    of cameras and hidden folders in the folder are searched, too.

    Args:
        folder: The folder.
        listed: The files that a job file lists.

    Raises:
        CaptureError: There is such a file.
    """
    inner = [path for path in readable_entries(folder) if path.is_dir() and _may_hold_copies(path)]
    paths = [path for place in (folder, *inner) for path in readable_entries(place) if path.is_file()]
    for found in unfinished_files((path, path.relative_to(folder).as_posix()) for path in paths):
        if found.lacks_video and found.path not in listed:
            raise CaptureError(
                f"this file is an unfinished copy of a video: {found.reason}", path=found.path, hint=_HINT
            )
    for path in _videos_without_suffix(folder):
        if path not in listed:
            raise CaptureError(
                f"this file is a video, but {path.suffix or 'its name'} does not say so",
                path=path,
                hint=f"rename it (for example to {path.stem}.mp4), or {_HINT}",
            )


def _videos_without_suffix(folder: Path) -> Iterator[Path]:
    """Yield the videos that have the name of a place on the body, but not the suffix of a video.

    Videos that are there with a suffix are omitted: cameras write small copies beside them.
    """
    entries = [path for path in readable_entries(folder) if not path.name.startswith(".")]
    stems = {path.stem.lower() for path in entries if is_video(path) or path.is_dir()}
    for path in entries:
        is_known = path.suffix.lower() in VIDEO_SUFFIXES | _SIDECAR_SUFFIXES or path.stem.lower() in stems
        if not is_known and mount_of(path.stem) is not None and is_video_by_content(path):
            yield path


def unreadable_videos(path: Path) -> dict[Path, str]:
    """Return why a video, or a video in a folder, cannot be opened, for each such video.

    A video cannot be opened if its structure shows that no frame can be read.
    """
    videos = filter(is_video, readable_entries(path) if path.is_dir() else [path])
    parts = {video: missing_part(video, VIDEO_SUFFIXES) for video in videos}
    return {video: part.text for video, part in parts.items() if part is not None and not part.readable_bytes}


def _may_hold_copies(folder: Path) -> bool:
    """Return True for the folder of a camera, a hidden folder and a download that is a folder."""
    entries = readable_entries(folder)
    is_named = folder.name.startswith(".") or names_video(folder.name) or mount_of(folder.name) is not None
    return folder / RUN_FILE not in entries and (is_named or any(map(is_video, entries)))


def _relevant(files: Iterable[tuple[Path, str]]) -> list[tuple[Path, str, _ParsedName, bool]]:
    """Return each relevant file with its parsed name, and whether the video in its name is in the folder.

    The latter is True for the video itself.
    """
    parsed = [(path, name, _parsed(name)) for path, name in files]
    videos = {(each.folder, each.video.lower()) for _, _, each in parsed if each.is_video}
    found = []
    for path, name, each in parsed:
        has_video = (each.folder, each.video.lower()) in videos
        is_copy = each.is_longer or (
            bool(each.video) and not has_video and missing_part(path, frozenset()) is not None
        )
        if is_copy or not each.is_system:
            found.append((path, name, each, has_video))
    return found


def _parsed(name: str) -> _ParsedName:
    parts = PurePosixPath(name).parts
    in_system = next((i for i, part in enumerate(parts[:-1]) if is_system_folder(part)), None)
    is_hidden = parts[-1 if in_system is None else in_system].startswith(".")
    ends = [max((found.end() for found in _VIDEO_NAME.finditer(part)), default=0) for part in parts]
    # A download may be a folder with the name of the video (torso.mp4.download).
    longer = [i for i, (part, end) in enumerate(zip(parts, ends, strict=True)) if 0 < end < len(part)]
    place = longer[0] if longer and in_system is None else len(parts) - 1
    return _ParsedName(
        folder="/".join(parts[: place if in_system is None else in_system]),
        video=parts[place][: ends[place]].lstrip(".~") if is_hidden or in_system is None else "",
        is_longer=bool(longer) and in_system is None,
        is_system=is_hidden or in_system is not None,
        is_sidecar=PurePosixPath(name).suffix.lower() in _SIDECAR_SUFFIXES,
    )
