"""Limits for jobs that others submit; jobs that the user runs have none."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass

from bodycap_batch.config.yaml_source import MAX_BYTES, MAX_DEPTH
from bodycap_batch.core.errors import JobError

_MAX_YAML_DEPTH = 100
"""Largest value of ``yaml_depth``, levels: blocks are read recursively, and Python's own limit is 1,000."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Limits of one job.

    Attributes:
        yaml_kb: Size of the job file, kilobytes (1024 bytes).
        yaml_depth: Levels to which its blocks may be nested.
        files: Number of files in one dropped folder.
        video_gb: Size of one video file, 10⁹ bytes.
        video_hours: Duration of one video file.
        video_px: Long side of a video's frames, pixels.
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
                    f"{field.name}={value:g} is not a limit", field="--limit", hint="a number above 0"
                )
        if self.yaml_depth > _MAX_YAML_DEPTH:
            hint = f"at most {_MAX_YAML_DEPTH}; the shipped limit is {MAX_DEPTH}"
            raise JobError(f"yaml_depth={self.yaml_depth:g} is too deep", field="--limit", hint=hint)


def limits_from(settings: Iterable[str]) -> Limits:
    """Return the limits that ``name=value`` texts state.

    Raises:
        JobError: An unknown name, or a value that is not a positive number.
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
            hint = f"NAME=NUMBER, with NAME one of {', '.join(known)}"
            raise JobError(f"no limit: {setting!r}", field="--limit", hint=hint) from error
    return Limits(**values)
