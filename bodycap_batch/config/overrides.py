"""The values of the command line that replace values of a job, and those of the last run of the job.

The next run of a job keeps the values that its last run got from the command line, unless the command line
or the job file gives others. Otherwise a batch would replace results with the subject's height by results
with the height of a mean adult.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict

from bodycap_batch.config.folder import JOB_FILES, PARTIAL, RUN_FILE
from bodycap_batch.config.models import CameraConfig, Job
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of
from bodycap_batch.config.origins import Source
from bodycap_batch.core.errors import JobError
from bodycap_batch.store.checked_json import parse_checked_json

COMMAND_LINE = "command_line"
"""Name of the field of ``run.json`` with the values of the command line."""
NO_HEIGHT = "none"
"""Value of `Overrides.height_m` for a run without a height, although the job or its last run has one."""
_PLAIN = ("height_m", "skeleton", "activity")
"""Fields of `Overrides`, `LastRun` and `Job` with one value."""


class LastRun(BaseModel):
    """The values of the command line of the last run, by field of `Overrides`."""

    model_config = ConfigDict(frozen=True)

    height_m: float | None = None
    skeleton: str | None = None
    activity: str | None = None
    mounts: dict[str, str] = {}
    places: tuple[str, ...] = ()

    @classmethod
    def of_results(cls, results: Path) -> LastRun:
        """Return the values that a folder of results records; no values if there is no sound record."""
        for folder in (results, results / PARTIAL):
            try:
                record = parse_checked_json((folder / RUN_FILE).read_bytes())
                if COMMAND_LINE in record:
                    return cls.model_validate(record[COMMAND_LINE])
                # An earlier version did not record the command line, but the job with its height.
                job = yaml.safe_load((folder / JOB_FILES[0]).read_text(encoding="utf-8"))
                return cls(height_m=job.get("height_m"))
            except (OSError, ValueError, AttributeError, yaml.YAMLError):  # no run, or a damaged record
                continue
        return cls()


@dataclass(frozen=True, slots=True, kw_only=True)
class Overrides:
    """Values of the command line that replace values of the job. Paths are relative to the working folder.

    Attributes:
        out: Folder for the results.
        out_parent: Folder that contains the folder for the results, if the job names no folder.
        skeleton: Name of a skeleton, or path of a skeleton file.
        height_m: Height of the subject, metres; `NO_HEIGHT` for the height of a mean adult.
        mounts: Place on the body of each named camera, by the name of the camera or of its video.
        last_mounts: The same of the last run, for cameras whose place the job file does not give.
        activity: What the subject does.
        places: The places where the cameras were, in any order, if it is unknown which camera was where.
        require: What the result must reach, such as ``good,0.9``. It is not kept for the next run.
    """

    out: Path | None = None
    out_parent: Path | None = None
    skeleton: str | None = None
    height_m: float | Literal["none"] | None = None
    mounts: Mapping[str, str] = field(default_factory=dict)
    last_mounts: Mapping[str, str] = field(default_factory=dict)
    activity: str | None = None
    places: tuple[str, ...] = ()
    require: str | None = None

    def place_of(self, camera: CameraConfig) -> tuple[str, Source] | None:
        """Return the place that is given for a camera, and where it comes from; None if none is given."""
        names = (camera.name, *(video.name for video in camera.video))
        if (place := _place_of(names, self.mounts)) is not None:
            return place, "command line"
        is_stated = camera.mount is not None or camera.segment is not None
        place = None if is_stated else _place_of(names, self.last_mounts)
        return None if place is None else (place, "last run")

    def is_known(self, name: str) -> bool:
        """Return True if the place of a video is given or found later, or if its name contains the place."""
        given = _place_of((name,), self.mounts) or _place_of((name,), self.last_mounts)
        return bool(self.places) or given is not None or mount_of(name) is not None

    def mounted(self, camera: CameraConfig) -> tuple[CameraConfig, Source]:
        """Return a camera with the place that is given for it, or unchanged, and where its place comes from.

        Raises:
            JobError: The place is unknown.
        """
        given = self.place_of(camera)
        if given is None:
            return camera, "job file"
        place, source = given
        if mount_of(place) is None:
            raise JobError(
                f"there is no place {place[:40]!r} on the body",
                field="--camera",
                hint=f"use one of {', '.join(MOUNT_NAMES)}",
            )
        return camera.model_copy(update={"mount": place, "mount_source": None, "segment": None}), source

    def require_used(self, cameras: Sequence[CameraConfig]) -> None:
        """Check that each name in `mounts` belongs to a camera. Raises `JobError`."""
        for name in self.mounts:
            if not any(Overrides(mounts={name: ""}).place_of(camera) is not None for camera in cameras):
                raise JobError(
                    f"there is no camera {name[:40]!r}",
                    field="--camera",
                    hint=f"use one of these names: {', '.join(camera.name for camera in cameras)}",
                )

    def with_last_run(self, stated: Mapping[str, Any], results: Path) -> tuple[Overrides, str]:
        """Add the values of the last run, and return a sentence about them; "" if none is added.

        Args:
            stated: The data of the job file. Its values replace those of the last run.
            results: Folder of the results of the last run.
        """
        last, capture = LastRun.of_results(results), stated.get("capture")
        values = {
            name: value
            for name in _PLAIN
            if (value := getattr(last, name)) is not None
            and name not in stated
            and getattr(self, name) is None
        }
        # Places to be found and stated places exclude each other. The command line decides which hold.
        kept = {} if self.places else last.mounts
        mounts = {name: place for name, place in kept.items() if name not in self.mounts}
        has_places = self.places or self.mounts or (isinstance(capture, dict) and capture.get("places"))
        places = self.places if has_places else last.places
        options = [f"--{name.removesuffix('_m')} {value}" for name, value in values.items()]
        options += [f"--camera {name}={place}" for name, place in mounts.items()]
        options += [f"--places {','.join(places)}"] if places != self.places else []
        text = f"as in the last run of this job: {' '.join(options)}" if options else ""
        return replace(self, **values, last_mounts=mounts, places=places), text


def values_to_record(job: Job, overrides: Overrides, results: Path) -> dict[str, Any]:
    """Return the values of the command line for the record of a run.

    They are those of this run's command line, and those of the last run that the job still has.

    Args:
        job: The job as it was run.
        overrides: The values of this run's command line.
        results: Folder of the results, with the record of the last run.
    """
    last, cameras = LastRun.of_results(results), job.capture.cameras
    used = {camera.mount for camera in cameras}
    is_found = bool(job.capture.places) or any(camera.mount_source is not None for camera in cameras)
    kept = LastRun(
        **{
            name: value
            for name in _PLAIN
            if (value := getattr(job, name)) == getattr(last, name) or getattr(overrides, name) is not None
        },
        mounts={name: place for name, place in {**last.mounts, **overrides.mounts}.items() if place in used},
        places=overrides.places or (last.places if is_found else ()),
    )
    return kept.model_dump(mode="json", exclude_none=True)


def _place_of(names: Sequence[str], by_name: Mapping[str, str]) -> str | None:
    """Return the place that is given for one of the names of a camera; None if none is given."""
    found = (place for name in names for given, place in by_name.items() if _is_same(given, name))
    return next(found, None)


def _is_same(given: str, name: str) -> bool:
    """Return True if two names are equal regardless of upper and lower case and of the suffix of a video."""
    return (
        given.lower() in (name.lower(), Path(name).stem.lower()) or Path(given).stem.lower() == name.lower()
    )
