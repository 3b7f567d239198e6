"""Find the videos beside a job file that the file does not list, and add them to the cameras of the job."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.folder import (
    JOB_FILES,
    RUN_FILE,
    VIDEO_SUFFIXES,
    Recording,
    camera_block,
    grouped_recordings,
    has_chapters,
    is_video,
    real_path,
    shown_name,
    visible_entries,
)
from bodycap_batch.config.models import CameraConfig
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.config.unfinished_videos import refuse_missing_cameras, unreadable_videos
from bodycap_batch.core.errors import CaptureError


@dataclass(frozen=True, slots=True, kw_only=True)
class VideosBeside:
    """What the folder of a job file holds besides the listed cameras.

    Attributes:
        cameras: The raw blocks of the cameras to add.
        reasons: For each video that is not used, the reason.
        warnings: Sentences about videos that the user probably wanted to use.
        unreadable: For each of these videos that cannot be opened, the reason.
    """

    cameras: list[dict[str, object]] = field(default_factory=list)
    reasons: dict[Path, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    unreadable: dict[Path, str] = field(default_factory=dict)

    def leave_out(self, paths: Sequence[Path], reason: str, advice: str = "") -> None:
        """Record videos that are not used, with the reason.

        Args:
            paths: The videos, or a folder of chapters.
            reason: The reason.
            advice: What the user can do. If it is given, there is a warning with this advice.
        """
        self.reasons.update(dict.fromkeys(paths, reason))
        if advice:
            names = ", ".join(shown_name(Path(path.name)) for path in paths)
            verb = "is" if len(paths) == 1 else "are"
            unreadable = {video: why for path in paths for video, why in unreadable_videos(path).items()}
            what = "".join(
                f"; {shown_name(Path(v.name))} cannot be opened: {w}" for v, w in unreadable.items()
            )
            self.warnings.append(f"{names} {verb} not used: {reason}; {advice}{what}")
            self.unreadable.update(unreadable)


def find_videos_beside(
    job_file: Path, listed: Sequence[CameraConfig], is_known: Callable[[str], bool]
) -> VideosBeside:
    """Find the videos in the folder of a job file that no camera of the job file lists.

    A video belongs to a listed camera if it is the same file, if the camera lists a folder that holds it, or
    if it is a folder that holds a listed file. Otherwise it becomes a camera. It is left out with a warning
    if a listed camera has its name, or if its name is not a known place on the body.

    Args:
        job_file: The job file.
        listed: The cameras of the job file. Their paths are relative to the folder of the job file.
        is_known: Function that returns True if the place of a video on the body is known. Its argument is the
            name of the video.

    Raises:
        CaptureError: The folder cannot be read. Or a symbolic link to a video leads nowhere, and its name is
            the name of a camera that the job file does not list. Or a file is an unfinished copy of a video.
    """
    folder, found = job_file.parent, VideosBeside()
    refuse_missing_cameras(folder, [folder / video for camera in listed for video in camera.video])
    other = next((name for name in JOB_FILES if name != job_file.name and (folder / name).is_file()), None)
    if other is not None:
        found.leave_out(
            [folder / other], f"the job file is {job_file.name}", "keep one of the two files in the folder"
        )
    recordings = grouped_recordings(_candidates(folder, listed, found))
    # A link comes after the video that it leads to.
    recordings.sort(key=lambda recording: recording[1][0].is_symlink())
    added: list[Recording] = []
    for name, paths in recordings:
        if not _belongs_to_listed_camera(folder, paths, listed, found):
            same = next((path for _, files in added for path in files if _is_same(path, paths[0])), None)
            if same is None:
                added.append((name, paths))
            else:
                found.leave_out(paths, f"the same file as {shown_name(Path(same.name))}")
    names = {camera.name.lower() for camera in listed}
    for name, paths in _without_equal_names(added, found):
        block = camera_block(name, paths[0])
        advice = f"list it under `cameras:` in {job_file.name}, or state `cameras_only: true`"
        if str(block["name"]).lower() in names:
            found.leave_out(paths, f"camera {block['name']} of {job_file.name} lists another video", advice)
        elif not is_known(name):
            reason = "the name is not a known place on the body"
            found.leave_out(paths, reason, f"rename it (for example to left_palm.mp4), {advice}")
        else:
            found.cameras.append(block)
    return found


def _candidates(folder: Path, listed: Sequence[CameraConfig], found: VideosBeside) -> list[Path]:
    """Return the videos and the folders of chapters in a folder; record those that cannot be used."""
    names = {camera.name.lower() for camera in listed}
    candidates = []
    try:
        entries = visible_entries(folder)
    except OSError as error:
        raise CaptureError(f"cannot read the folder ({error})", path=folder, hint="check the path") from error
    for path in entries:
        if path.is_symlink() and not path.exists() and path.suffix.lower() in VIDEO_SUFFIXES:
            is_listed = any(
                _is_same_path(path, folder / video) for camera in listed for video in camera.video
            )
            if mount_of(path.stem) is not None and path.stem.lower() not in names and not is_listed:
                raise CaptureError(
                    "a link that leads nowhere",
                    path=path,
                    hint="link it again, copy the video itself, or state `cameras_only: true`",
                )
            if not is_listed:
                found.leave_out([path], "a link that leads nowhere")
        elif is_video(path):
            candidates.append(path)
        elif path.is_dir():
            try:
                has_video = has_chapters(path)
            except OSError as error:
                found.leave_out(
                    [path],
                    f"cannot be read ({error.strerror})",
                    "give the user who runs bodycap the permission to read and open this folder (chmod)",
                )
                continue
            if has_video:
                candidates.append(path)
            elif (
                mount_of(path.name) is not None
                and path.name.lower() not in names
                and not (path / RUN_FILE).is_file()
            ):
                found.leave_out([path], "holds no video", "copy the videos again, or remove the folder")
    return candidates


def _belongs_to_listed_camera(
    folder: Path, paths: Sequence[Path], listed: Sequence[CameraConfig], found: VideosBeside
) -> bool:
    """Return True if a recording belongs to a listed camera; record its videos that are not listed."""
    owners = {
        path: camera
        for path in paths
        for camera in listed
        if any(_is_part_of(path, folder / video) for video in camera.video)
    }
    if not owners:
        return False
    owner = next(iter(owners.values()))
    places = [folder / video for camera in listed for video in camera.video]
    missing = [path for path in paths if path not in owners]
    if paths[0].is_dir() and mount_of(paths[0].name) is not None and not _is_listed(paths[0], places):
        missing = [
            path for path in sorted(paths[0].iterdir()) if is_video(path) and not _is_listed(path, places)
        ]
    if missing:
        reason = f"camera {owner.name} lists other chapters of this video"
        found.leave_out(missing, reason, "list all chapters, in the order in which they were recorded")
    for path, camera in owners.items():
        if path.is_file() and not any(
            _is_same_path(path, place) or _is_inside(path, place) for place in places
        ):
            found.leave_out([path], f"the same file as the video of camera {camera.name}")
    return True


def _is_listed(path: Path, places: Sequence[Path]) -> bool:
    return any(_is_same(path, place) for place in places)


def _is_part_of(path: Path, place: Path) -> bool:
    """Return True if a video or folder is the listed file or folder, lies in it, or holds it."""
    if _is_same(path, place) or _is_inside(path, place):
        return True
    return path.is_dir() and real_path(place).is_relative_to(real_path(path))


def _is_inside(path: Path, place: Path) -> bool:
    return real_path(path).parent == real_path(place)


def _is_same(first: Path, second: Path) -> bool:
    """Return True if two paths lead to one file: through symbolic links, or as hard links."""
    if real_path(first) == real_path(second):
        return True
    try:
        return first.is_file() and first.samefile(second)
    except (OSError, ValueError):  # there is no second file, or its name holds a null character
        return False


def _is_same_path(first: Path, second: Path) -> bool:
    return os.path.normpath(first) == os.path.normpath(second)


def _without_equal_names(recordings: Sequence[Recording], found: VideosBeside) -> list[Recording]:
    """Return the recordings to add; leave out those whose cameras would have the same name."""
    by_name: dict[str, list[Recording]] = {}
    for name, paths in recordings:
        by_name.setdefault(str(camera_block(name, paths[0])["name"]).lower(), []).append((name, paths))
    for equal in by_name.values():
        if len(equal) > 1:
            together = [path for _, files in equal for path in files]
            found.leave_out(together, "their cameras would have the same name", "rename all but one of them")
    return [equal[0] for equal in by_name.values() if len(equal) == 1]
