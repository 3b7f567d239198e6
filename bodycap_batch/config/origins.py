"""Where the settings of each camera come from, and which files of the capture's folder are not used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bodycap_batch.config.folder import (
    CALIBRATION_FILE,
    JOB_FILES,
    RUN_FILE,
    VIDEO_SUFFIXES,
    is_video,
    real_path,
    shown_name,
)
from bodycap_batch.config.models import Job
from bodycap_batch.config.sample_files import SAMPLE_SUFFIXES
from bodycap_batch.config.videos_beside import VideosBeside

Source = Literal[
    "command line",
    "last run",
    "job file",
    "folder",
    "sidecar file",
    "calib.json",
    "video metadata",
    "camera name",
    "lens profile",
    "motion",
    "default",
]
"""Kind of place that a setting comes from. "last run" means the command line of the last run; "folder" means
a video that the job file does not list, in the capture's folder; "sidecar file" means a file of timestamps or
samples beside the video; "lens profile" means the table of lenses, with the camera model that the video's
metadata name; "motion" means the motion of the cameras."""

_NOT_NAMED = "not a video, and no setting names it"


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """The place that one setting comes from.

    Attributes:
        source: Kind of the place.
        value: The value of the setting, as text for the user.
    """

    source: Source
    value: str

    def text(self) -> str:
        """Return the value and its origin as text for the user."""
        return f"{self.value} (default)" if self.source == "default" else f"{self.value} (from {self._place})"

    @property
    def _place(self) -> str:
        return self.source if self.source == "calib.json" else f"the {self.source}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOrigins:
    """The origins of one camera's settings.

    Attributes:
        video: Origin of the list of the camera's videos.
        calibration: Origin of the calibration.
        first_guess: Origin of the field of view or of the lens from which `calibration: auto` starts. None if
        the camera is
            calibrated, or if the videos have not been opened.
        timestamps: Origin of the frame times.
        samples: Origin of the file with the samples of an inertial sensor; None if there is none.
        clock_offset: Origin of `offset_s`.
        clock_drift: Origin of the drift of the camera's clock.
        mount: Origin of the place on the body.
        mount_pose: Origin of the camera's pose relative to its bone.
    """

    video: Origin
    calibration: Origin
    first_guess: Origin | None = None
    timestamps: Origin
    samples: Origin | None = None
    clock_offset: Origin
    clock_drift: Origin
    mount: Origin
    mount_pose: Origin

    def lines(self) -> list[str]:
        """Return the origins as text for the user."""
        guess = "" if self.first_guess is None else f", starting at {self.first_guess.text()}"
        return [
            f"video: {self.video.text()}",
            f"calibration: {self.calibration.text()}{guess}",
            f"timestamps: {self.timestamps.text()}",
            *([] if self.samples is None else [f"inertial samples: {self.samples.text()}"]),
            f"clock: offset {self.clock_offset.text()}; drift {self.clock_drift.text()}",
            f"mount: {self.mount.text()}; pose on the bone: {self.mount_pose.text()}",
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class UnusedFile:
    """A file or a folder in the capture's folder that the job does not use.

    Attributes:
        path: Path relative to the capture's folder.
        reason: Reason why it is not used.
    """

    path: str
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedJob:
    """A resolved job, and the origins of its settings.

    Attributes:
        job: The resolved job.
        origins: The origins of each camera's settings, by camera name.
        folder: The capture's folder: the folder of videos, or the folder of the job file if videos of the job
            are in it. Otherwise None.
        job_file: The job file; None for a folder without a job file.
        calibration_files: The calibration files that were read.
        beside: The files and folders in the capture's folder that are known to be unused.
        unlisted: Reason why any other video in the capture's folder is not used.
        warnings: Sentences about what the user probably did not intend.
        no_body: Sentence that explains why no body is computed although the job does not say
            `skeleton: none`; "" otherwise.
    """

    job: Job
    origins: Mapping[str, CameraOrigins]
    folder: Path | None
    job_file: Path | None
    calibration_files: frozenset[Path]
    beside: VideosBeside
    unlisted: str
    warnings: tuple[str, ...]
    no_body: str

    def warnings_of_run(self) -> tuple[str, ...]:
        """Return the warnings for a run. The missing body is one of them if the job gives the height."""
        return (*self.warnings, *([self.no_body] if self.no_body and self.job.height_m is not None else ()))

    def unused_files(self) -> tuple[UnusedFile, ...]:
        """List the capture's folder, and return each file and each folder that the job does not use.

        Hidden files are omitted, unless they have the suffix of a video. A folder that the job does not use
        is one entry.
        """
        if self.folder is None:
            return ()
        used = self._used_files()
        found: list[UnusedFile] = []
        for path in sorted(self.folder.iterdir()):
            found += self._unused_in(path, used)
        return tuple(found)

    def _used_files(self) -> frozenset[Path]:
        files = {real_path(path) for _, path in self.job.files()}
        if self.job_file is not None:
            files.add(real_path(self.job_file))
        return frozenset(files | self.calibration_files)

    def _unused_in(self, path: Path, used: frozenset[Path]) -> list[UnusedFile]:
        if path in self.beside.reasons:
            return [self._unused(path, self.beside.reasons[path])]
        target = real_path(path)
        if target in used:
            return []
        if path.name.startswith("."):
            is_copy = path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith("._")
            return [self._unused(path, "a hidden file")] if is_copy else []
        if not path.is_dir():
            return [self._unused(path, self._reason(path))]
        if any(file.is_relative_to(target) for file in used):
            return self._unused_beside_chapters(path, used)
        if self.job.out is not None and self.job.out.is_relative_to(target):
            return []  # the folder of this job's results
        return [self._unused(path, self._folder_reason(path))]

    def _unused_beside_chapters(self, folder: Path, used: frozenset[Path]) -> list[UnusedFile]:
        """Return the unused files of a folder that holds files of the job, without its own folders."""
        return [
            self._unused(path, self.beside.reasons.get(path, self._reason(path)))
            for path in sorted(folder.iterdir())
            if not path.name.startswith(".") and path.is_file() and real_path(path) not in used
        ]

    def _unused(self, path: Path, reason: str) -> UnusedFile:
        assert self.folder is not None
        name = shown_name(path.relative_to(self.folder))
        return UnusedFile(path=f"{name}/" if path.is_dir() else name, reason=reason)

    def _reason(self, path: Path) -> str:
        """Return the reason why a file is not used."""
        name = path.name.lower()
        if path.is_symlink() and not path.exists():
            return "a link that leads nowhere"
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return self.unlisted
        if name in JOB_FILES:
            return f"the job file is {self.job_file.name}" if self.job_file else "the folder holds results"
        if name.endswith((".yaml", ".yml")):
            return f"a job file must have the name {JOB_FILES[0]}, and a calibration must be named in it"
        if name == CALIBRATION_FILE:
            if any(origins.calibration.source == "default" for origins in self.origins.values()):
                return f"only a {JOB_FILES[0]} uses it without `calibration:`"
            return "the calibration of every camera comes from elsewhere"
        for suffix in (".timestamps.txt", *SAMPLE_SUFFIXES):
            if name.endswith(suffix):
                other = "" if suffix not in SAMPLE_SUFFIXES else ", or the camera has another file of samples"
                return f"the part before {suffix} is not the name of a camera or a video{other}"
        return _NOT_NAMED

    def _folder_reason(self, folder: Path) -> str:
        try:
            if (folder / RUN_FILE).is_file():
                return "results of a run"
            return self.unlisted if any(map(is_video, folder.iterdir())) else "holds no video"
        except OSError as error:
            return f"cannot be read ({error.strerror})"
