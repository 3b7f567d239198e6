"""Resolve one camera of a job: find its chapters, sidecar files and calibration, and record their origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.config.calibration import Calibration, CalibrationEntry, read_calibration
from bodycap_batch.config.folder import calibration_in, chapters_in, real_path, shown_name
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.mounts import place_of_role
from bodycap_batch.config.origins import CameraOrigins, Origin, Source
from bodycap_batch.config.sample_files import samples_beside
from bodycap_batch.core.errors import CaptureError


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedCamera:
    """A resolved camera, and where its settings come from.

    Attributes:
        config: The camera, with absolute paths, all chapters and sidecar files, and its calibration.
        origins: The origins of its settings.
        calibration_file: The calibration file that was read; None if there is none.
    """

    config: CameraConfig
    origins: CameraOrigins
    calibration_file: Path | None


def with_found_calibrations(capture: CaptureConfig, folder: Path) -> CaptureConfig:
    """Return a capture that names the calibration files in its folder.

    The calibration of a camera is, in this order: the camera's own in the job file, the capture's in the job
    file, ``calib.json`` in the camera's folder of chapters, ``calib.json`` beside the videos.

    Args:
        capture: The capture as the job file gives it.
        folder: Folder of the videos, to which the paths of the capture are relative.

    Raises:
        CaptureError: A calibration file is a symbolic link that leads nowhere.
    """
    if capture.calibration is not None:
        return capture
    cameras = []
    for camera in capture.cameras:
        place = folder / camera.video[0]
        own = None
        if camera.calibration is None and len(camera.video) == 1 and place.is_dir():
            own = calibration_in(place)
        cameras.append(camera if own is None else camera.model_copy(update={"calibration": own}))
    found = None
    if any(camera.calibration is None for camera in cameras):
        found = calibration_in(folder)
    return capture.model_copy(update={"cameras": tuple(cameras), "calibration": found})


def resolved_camera(
    index: int, capture: CaptureConfig, stated: CaptureConfig, base: Path, placed: Mapping[str, Source]
) -> ResolvedCamera:
    """Resolve one camera.

    Args:
        index: Index of the camera.
        capture: The capture with the calibration files that `with_found_calibrations` found.
        stated: The capture as the job file states it. It has fewer cameras if videos beside the job file were
            added. If there is no job file, it has no cameras.
        base: Folder to which the paths of the capture are relative.
        placed: Where the place of each camera would come from, by camera name.

    Raises:
        CaptureError: A calibration cannot be used, a folder holds no video, or the number of timestamp files
            differs from the number of chapters.
    """
    camera = capture.cameras[index]
    listed = stated.cameras[index] if index < len(stated.cameras) else None
    videos, sidecars = _chapters(camera, base)
    if camera.timestamps:
        sidecars = tuple(real_path(base / path) for path in camera.timestamps)
    if len(sidecars) not in (0, 1, len(videos)):
        raise CaptureError(
            f"camera {camera.name} has {len(sidecars)} timestamp files for {len(videos)} chapters",
            path=sidecars[0],
            field=f"capture.cameras.{index}.timestamps",
            hint="give one timestamp file for the whole camera, or put one beside every chapter",
        )
    calibration = camera.calibration if camera.calibration is not None else capture.calibration
    entry: CalibrationEntry | None = None
    file: Path | None = None
    if isinstance(calibration, Path):
        file = real_path(base / calibration)
        entry = read_calibration(file, camera.name)
        calibration = entry.calibration
    update: dict[str, Any] = {"video": videos, "timestamps": sidecars, "calibration": calibration or "auto"}
    stated_videos = [base / video for video in camera.video]
    found = samples_beside(videos, camera.name, stated_videos)
    update["samples"] = found if camera.samples is None else base / camera.samples
    if camera.mask is not None:
        update["mask"] = real_path(base / camera.mask)
    if camera.offset_s is None:
        is_common = capture.clocks == "common" or capture.reference_camera().name == camera.name
        in_file = entry.offset_s if entry else None
        update["offset_s"] = 0.0 if in_file is None and is_common else in_file
    if camera.rolling_shutter_s is None:
        update["rolling_shutter_s"] = entry.rolling_shutter_s if entry else None
    config = camera.model_copy(update=update)
    is_stated = stated.calibration is not None or (listed is not None and listed.calibration is not None)
    origins = CameraOrigins(
        video=Origin(source="folder" if listed is None else "job file", value=_file_names(videos)),
        calibration=_calibration_origin(config, file, base, is_stated=is_stated),
        timestamps=_file_origin(config.timestamps, is_stated=bool(camera.timestamps))
        or Origin(source="video metadata", value="frame times"),
        samples=_file_origin(
            () if config.samples is None else (config.samples,), is_stated=camera.samples is not None
        ),
        clock_offset=_clock_origin(camera, capture, camera.offset_s, "s")
        if camera.offset_s is not None or file is None or entry is None or entry.offset_s is None
        else Origin(source="job file", value=f"{entry.offset_s:g} s in {file.name}")
        if is_stated
        else Origin(source="calib.json", value=f"{entry.offset_s:g} s"),
        clock_drift=_clock_origin(camera, capture, camera.drift_ppm, "ppm"),
        mount=_mount_origin(config, capture.places, placed[config.name]),
        mount_pose=Origin(source="default", value="typical of the place")
        if camera.joint_from_cam is None
        else Origin(source="job file", value="measured"),
    )
    return ResolvedCamera(config=config, origins=origins, calibration_file=file)


def _file_names(paths: tuple[Path, ...]) -> str:
    names = [shown_name(Path(path.name)) for path in paths]
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}, {len(names)} files"


def _calibration_origin(config: CameraConfig, file: Path | None, folder: Path, *, is_stated: bool) -> Origin:
    if isinstance(config.calibration, str) and config.calibration != "auto":
        return Origin(source="job file", value=config.calibration)
    if not isinstance(config.calibration, Calibration):
        return Origin(source="job file" if is_stated else "default", value="auto")
    model = config.calibration.model
    if file is None:
        return Origin(source="job file", value=model)
    if is_stated:
        return Origin(source="job file", value=f"{model} in {file.name}")
    in_folder = file.parent == real_path(folder)
    return Origin(source="calib.json", value=model if in_folder else f"{model} of {file.parent.name}/")


def _file_origin(files: tuple[Path, ...], *, is_stated: bool) -> Origin | None:
    """Return the origin of files that lie beside the video or that the job names; None if there are none."""
    source: Source = "job file" if is_stated else "sidecar file"
    return Origin(source=source, value=_file_names(files)) if files else None


def _clock_origin(camera: CameraConfig, capture: CaptureConfig, stated: float | None, unit: str) -> Origin:
    """Return the origin of the offset or the drift of a camera's clock.

    Args:
        camera: The camera as the job states it.
        capture: The capture, which says whether all clocks agree.
        stated: The value that the job states; None if it states none.
        unit: Unit of the value.
    """
    if stated is not None:
        return Origin(source="job file", value=f"{stated:g} {unit}")
    if capture.clocks == "common":
        return Origin(source="job file", value=f"0 {unit}, common clocks")
    if capture.reference_camera().name != camera.name:
        return Origin(source="default", value="auto")
    return Origin(source="default", value="0 s, the reference clock" if unit == "s" else f"0 {unit}")


def _mount_origin(config: CameraConfig, places: Sequence[str], stated_in: Source) -> Origin:
    if config.mount_source is not None:
        return Origin(source=config.mount_source, value=str(config.mount))
    if config.segment is not None or config.mount is not None:
        return Origin(source=stated_in, value=str(config.segment or config.mount))
    if config.role is None and places:
        return Origin(source="motion", value=f"found by the run, one of {', '.join(places)}")
    if config.role is None:
        return Origin(source="default", value="unknown")
    return Origin(source="camera name", value=place_of_role(config.role))


def _chapters(camera: CameraConfig, base: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return the video files of a camera in order, and the sidecar files with the videos' timestamps.

    The first of these that exists is used: the sidecar of a folder of chapters, the sidecars of the chapters
    (``<video>.timestamps.txt``), the file ``<camera>.timestamps.txt``. For a symbolic link, they are looked
    for beside the link, then beside its target.
    """
    videos: list[Path] = []
    beside: list[Path] = []
    places = [base / video for video in camera.video]
    for place in places:
        target = real_path(place)
        if place.is_dir():
            chapters = chapters_in(target)
            whole = _sidecars_of(place) if len(places) == 1 else []
            beside += whole or [sidecar for chapter in chapters for sidecar in _sidecars_of(chapter)]
            videos += chapters
        else:
            beside += _sidecars_of(place)
            videos.append(target)
    return tuple(videos), tuple(beside or _first_beside(places[0], f"{camera.name}.timestamps.txt"))


def _sidecars_of(video: Path) -> list[Path]:
    """Return the sidecar file of a video or folder: a list with one path, or an empty list.

    Its name is ``torso.timestamps.txt`` or ``torso.mp4.timestamps.txt``; the first name is preferred.
    """
    target = real_path(video)
    return (
        _first_beside(video, f"{video.stem}.timestamps.txt", f"{video.name}.timestamps.txt")
        or _first_beside(target, f"{target.stem}.timestamps.txt", f"{target.name}.timestamps.txt")
    )  # fmt: skip


def _first_beside(path: Path, *names: str) -> list[Path]:
    """Return the first existing file with one of the names beside a path, else beside its target."""
    places = (path, real_path(path))
    found = [place.with_name(name) for place in places for name in names if place.with_name(name).is_file()]
    return [real_path(file) for file in found[:1]]
