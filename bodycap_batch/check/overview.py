"""Show where the settings of each camera come from, and which files of the folder are not used."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.capture.initial_intrinsics import guessed_fov_deg
from bodycap_batch.capture.lens_choice import chosen_lens
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.job import load_job_with_origins
from bodycap_batch.config.models import CameraConfig
from bodycap_batch.config.origins import CameraOrigins, Origin, UnusedFile

_LINE_WIDTH = 100
"""Maximum number of characters in a line of unused files."""


def with_first_guess(origins: CameraOrigins, config: CameraConfig, video: VideoFile) -> CameraOrigins:
    """Return the origins with that of the field of view from which `calibration: auto` starts.

    Args:
        origins: The origins of a camera's settings.
        config: The resolved camera.
        video: The first video of the camera.
    """
    if isinstance(config.calibration, Calibration):
        return origins
    lens = chosen_lens(config, video)
    if lens is not None:
        return replace(origins, first_guess=Origin(source="lens profile", value=lens.profile.text()))
    fov_deg, source = guessed_fov_deg(video, config.fov_deg)
    return replace(origins, first_guess=Origin(source=source, value=f"{fov_deg:.0f}°"))


def unused_lines(files: Sequence[UnusedFile]) -> list[str]:
    """Return the unused files as text for the user: for each reason, the files."""
    by_reason: dict[str, list[str]] = {}
    for file in files:
        by_reason.setdefault(file.reason, []).append(file.path)
    return [
        line
        for reason, paths in by_reason.items()
        for line in textwrap.wrap(
            f"not used ({reason}): {', '.join(paths)}",
            _LINE_WIDTH,
            subsequent_indent="  ",
            break_on_hyphens=False,
            break_long_words=False,
        )
    ]


def overview_lines(job_file: Path) -> list[str]:
    """Return where the settings of a job file come from, which may have blanks to fill in, as text.

    Raises:
        JobError: The file is not a job.
        CaptureError: A video or a calibration cannot be used.
    """
    loaded = load_job_with_origins(job_file, is_draft=True)
    lines = []
    for config in loaded.job.capture.cameras:
        origins = with_first_guess(loaded.origins[config.name], config, index_video(config.video[0]))
        lines += [f"{config.name}:", *(f"  {line}" for line in origins.lines())]
    lines += unused_lines(loaded.unused_files())
    return [*lines, *(f"note: {warning}" for warning in loaded.warnings)]
