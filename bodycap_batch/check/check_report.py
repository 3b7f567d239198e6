"""The result of a check, as data and as text."""

from __future__ import annotations

import dataclasses
import textwrap
from dataclasses import dataclass
from typing import Any

from bodycap_batch.capture.kept import should_keep_all
from bodycap_batch.check.overview import unused_lines
from bodycap_batch.config.models import NO_SKELETON, Job
from bodycap_batch.config.mounts import place_of_role
from bodycap_batch.config.origins import CameraOrigins, UnusedFile
from bodycap_batch.core.errors import BodycapError

_MAX_SHOWN_FILES = 3
"""Maximum number of a camera's video files that are listed by name."""
_LINE_WIDTH = 100
"""Maximum number of characters in a line of advice."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSummary:
    """Summary of the video files and the calibration of one camera.

    Attributes:
        name: Camera name.
        role: Role of the bone on which the camera is mounted; None if it is unknown.
        files: Names of the camera's video files.
        frames: Number of frames in all files.
        used_frames: Number of used frames. A frame is used if the frame's time is usable and lies between
            start_s and end_s.
        used_runs: First and last frame number of each run of successive used frames. Frames are numbered over
            all chapters of the video.
        start_s: Common time of the first used frame, seconds.
        end_s: Common time of the last used frame, seconds.
        fps: Nominal frame rate, frames per second.
        variable_rate: True if frames are not evenly spaced in time.
        size_px: Width and height of the video as a player shows it, pixels.
        work_size_px: Width and height at the work size (the image size that all stages work at), pixels.
        lens: Description of the intrinsics for the user.
        notes: Notes for the user that are not errors.
        guessed_lens: True if the camera has no calibration.
        origins: Where the settings of the camera come from; None if it is unknown.
        is_static: True if the inspected pictures stand still throughout the recording.
        is_worn: False if nobody wears the camera.
    """

    name: str
    role: str | None
    files: tuple[str, ...]
    frames: int
    used_frames: int
    used_runs: tuple[tuple[int, int], ...]
    start_s: float
    end_s: float
    fps: float
    variable_rate: bool
    size_px: tuple[int, int]
    work_size_px: tuple[int, int]
    lens: str
    notes: tuple[str, ...] = ()
    guessed_lens: bool = False
    origins: CameraOrigins | None = None
    is_static: bool = False
    is_worn: bool = True

    @property
    def large_frames(self) -> int:
        """Number of frames that are copied at the work size because the video is large.

        If the video is much larger than the work size, all used frames are copied. Otherwise the number is 0.
        """
        return self.used_frames if should_keep_all(self.size_px, self.work_size_px) else 0

    def lines(self) -> list[str]:
        """Return the summary as text for the user."""
        files = ", ".join(self.files[:_MAX_SHOWN_FILES])
        if len(self.files) > _MAX_SHOWN_FILES:
            files += f" … ({len(self.files)} chapters)"
        place = "place not known yet" if self.role is None else place_of_role(self.role)
        place = place if self.is_worn else "not on the body"
        width, height = self.size_px
        size = f"{width}×{height}"
        if self.work_size_px != self.size_px:
            size += f" (processed at {self.work_size_px[0]}×{self.work_size_px[1]})"
        rate = f"{self.fps:.2f} fps{', variable rate' if self.variable_rate else ''}"
        used = "" if self.used_frames == self.frames else f" ({self.used_frames} used)"
        span = (
            f"{self.end_s - self.start_s:.1f} s, {self.start_s:.2f} to {self.end_s:.2f} s on the common clock"
        )
        return [
            f"{self.name}: {files} -> {place}",
            f"  {size}, {rate}, {self.frames} frames{used}, {span}",
            f"  {self.lens}",
            *(f"  {line}" for line in ([] if self.origins is None else self.origins.lines())),
            *(f"  note: {note}" for note in self.notes),
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckReport:
    """The result of a check.

    Attributes:
        job: The resolved job; None if the job could not be resolved.
        cameras: The summary of each camera that passed the check.
        notes: Notes for the user about the job as a whole.
        errors: Errors that prevent the job from running.
        advice: Sentences about what would improve the result; empty if there are errors.
        unused_files: The files in the capture's folder that the job does not use.
    """

    job: Job | None = None
    cameras: tuple[CameraSummary, ...] = ()
    notes: tuple[str, ...] = ()
    errors: tuple[BodycapError, ...] = ()
    advice: tuple[str, ...] = ()
    unused_files: tuple[UnusedFile, ...] = ()

    @property
    def ready(self) -> bool:
        """True if the job can run."""
        return not self.errors

    @property
    def exit_code(self) -> int:
        """Exit code of the first error; 0 without errors."""
        return self.errors[0].exit_code if self.errors else 0

    def lines(self) -> list[str]:
        """Return the report as text for the user."""
        out = [line for camera in self.cameras for line in camera.lines()]
        out += unused_lines(self.unused_files)
        out += [f"note: {note}" for note in self.notes]
        out += [line for error in self.errors for line in f"problem: {error}".split("\n")]
        for number, sentence in enumerate(self.advice, start=1):
            mark = f"advice {number}: "
            out += textwrap.wrap(
                sentence,
                _LINE_WIDTH,
                initial_indent=mark,
                subsequent_indent=" " * len(mark),
                break_on_hyphens=False,
            )
        if self.ready:
            no_body = self.job is not None and self.job.skeleton == NO_SKELETON
            ready = "ready to run: map and camera paths, no body" if no_body else "ready to run"
            out.append(ready if self.cameras else "no problems found")
        else:
            count = len(self.errors)
            out.append(f"not ready: {count} problem{'s' if count > 1 else ''}")
        return out

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        return {
            "ready": self.ready,
            "cameras": [dataclasses.asdict(camera) for camera in self.cameras],
            "notes": list(self.notes),
            "errors": [error.to_dict() for error in self.errors],
            "advice": list(self.advice),
            "unused_files": [dataclasses.asdict(file) for file in self.unused_files],
        }
