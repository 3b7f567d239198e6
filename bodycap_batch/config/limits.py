"""Limits for jobs that other users submit. Jobs that the user runs directly have no limits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

from bodycap_batch.config.yaml_source import MAX_BYTES, MAX_DEPTH
from bodycap_batch.core.errors import JobError

_MAX_YAML_DEPTH = 100
"""Maximum value (levels) that an operator may set for ``yaml_depth``. Blocks are read recursively, and Python
limits recursion to 1,000 levels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits that one job of another user must respect. Each attribute is a maximum.

    Attributes:
        yaml_kb: Maximum size of the job file, in units of 1024 bytes.
        yaml_depth: Maximum nesting depth of the blocks in the job file, in levels.
        files: Maximum number of files in one dropped folder.
        video_gb: Maximum size of one video file, in units of 10⁹ bytes.
        video_hours: Maximum duration (hours) of one video file.
        video_px: Maximum length (pixels) of the long side of a video's frames.
    """

    yaml_kb: float = MAX_BYTES / 1024
    yaml_depth: float = MAX_DEPTH
    files: float = 10_000
    video_gb: float = 64.0
    video_hours: float = 4.0
    video_px: float = 8192

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not (math.isfinite(value := getattr(self, field.name)) and value > 0):
                raise JobError(
                    f"{field.name}={value:g} is not a limit", field="--limit", hint="give a number above 0"
                )
        if self.yaml_depth > _MAX_YAML_DEPTH:
            hint = f"give at most {_MAX_YAML_DEPTH}; the default is {MAX_DEPTH}"
            raise JobError(
                f"the limit yaml_depth={self.yaml_depth:g} is too large", field="--limit", hint=hint
            )


def limits_from(settings: Iterable[str]) -> Limits:
    """Return the limits given as texts ``name=value``; all other limits keep their defaults.

    Raises:
        JobError: A name is unknown, or a value is not a positive number.
    """
    known = [field.name for field in dataclasses.fields(Limits)]
    values: dict[str, float] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        try:
            if name not in known:
                raise ValueError(name)
            values[name] = float(value)
        except ValueError as error:
            hint = f"write NAME=NUMBER, where NAME is one of {', '.join(known)}"
            raise JobError(f"{setting!r} is not a limit", field="--limit", hint=hint) from error
    return Limits(**values)
