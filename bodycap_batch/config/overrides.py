"""The values of the command line that replace values of a job, and those of the last run of the job.

The next run of a job keeps the values that its last run got from the command line, unless the command line
or the job file gives others. Otherwise a batch would replace results with the subject's height by results
with the height of a mean adult.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from bodycap_batch.config.folder import JOB_FILES, PARTIAL, RUN_FILE
from bodycap_batch.config.models import Job
from bodycap_batch.store.checked_json import parse_checked_json

COMMAND_LINE = "command_line"
"""Name of the field of ``run.json`` with the values of the command line."""
NO_HEIGHT = "none"
"""Value of `Overrides.height_m` for a run without a height, although the job or its last run has one."""
_PLAIN: dict[str, type | tuple[type, ...]] = {"height_m": (float, int), "skeleton": str, "activity": str}
"""Fields of `Overrides` and `Job` with one value, and the types of the value."""


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
    """

    out: Path | None = None
    out_parent: Path | None = None
    skeleton: str | None = None
    height_m: float | Literal["none"] | None = None
    mounts: Mapping[str, str] = field(default_factory=dict)
    last_mounts: Mapping[str, str] = field(default_factory=dict)
    activity: str | None = None
    places: tuple[str, ...] = ()

    def with_last_run(self, stated: Mapping[str, Any], results: Path) -> tuple[Overrides, str]:
        """Add the values of the last run, and return a sentence about them; "" if none is added.

        Args:
            stated: The data of the job file. Its values replace those of the last run.
            results: Folder of the results of the last run.
        """
        last, capture = values_of_last_run(results), stated.get("capture")
        added: dict[str, Any] = {
            name: last[name]
            for name in _PLAIN
            if name in last and name not in stated and getattr(self, name) is None
        }
        if mounts := {name: place for name, place in last["mounts"].items() if name not in self.mounts}:
            added["last_mounts"] = mounts
        has_places = bool(self.places) or (isinstance(capture, dict) and bool(capture.get("places")))
        if last["places"] and not has_places:
            added["places"] = tuple(last["places"])
        options = [f"--{name.removesuffix('_m')} {added[name]}" for name in _PLAIN if name in added]
        options += [f"--camera {name}={place}" for name, place in added.get("last_mounts", {}).items()]
        options += [f"--places {','.join(added['places'])}"] if "places" in added else []
        text = f"as in the last run of this job: {' '.join(options)}" if options else ""
        return replace(self, **added), text


def values_of_last_run(results: Path) -> dict[str, Any]:
    """Return the values of the command line that a folder of results records, by field of `Overrides`.

    The fields `mounts` and `places` are always there.
    """
    found: Any = {}
    for folder in (results, results / PARTIAL):
        try:
            record = parse_checked_json((folder / RUN_FILE).read_bytes())
            found = record[COMMAND_LINE] if COMMAND_LINE in record else _height_of_job(folder / JOB_FILES[0])
            break
        except (OSError, ValueError, yaml.YAMLError):  # no run, or a damaged record
            continue
    found = found if isinstance(found, dict) else {}
    values = {name: found[name] for name, kinds in _PLAIN.items() if isinstance(found.get(name), kinds)}
    mounts, places = found.get("mounts"), found.get("places")
    return {
        **values,
        "mounts": mounts if isinstance(mounts, dict) else {},
        "places": places if isinstance(places, list) else [],
    }


def _height_of_job(file: Path) -> dict[str, Any]:
    """Return the height in the ``job.yaml`` of results whose version did not record the command line."""
    document = yaml.safe_load(file.read_text(encoding="utf-8"))
    return {"height_m": document.get("height_m")} if isinstance(document, dict) else {}


def values_to_record(job: Job, overrides: Overrides, results: Path) -> dict[str, Any]:
    """Return the values of the command line for the record of a run.

    They are those of this run's command line, and those of the last run that the job still has.

    Args:
        job: The job as it was run.
        overrides: The values of this run's command line.
        results: Folder of the results, with the record of the last run.
    """
    last = values_of_last_run(results)
    values = {name: getattr(job, name) for name in _PLAIN}
    cameras = job.capture.cameras
    used = {camera.mount for camera in cameras}
    mounts = {name: place for name, place in last["mounts"].items() if place in used}
    is_found = bool(job.capture.places) or any(camera.mount_source is not None for camera in cameras)
    return {
        **{
            name: value
            for name, value in values.items()
            if value is not None and (getattr(overrides, name) is not None or last.get(name) == value)
        },
        "mounts": {**mounts, **overrides.mounts},
        "places": list(overrides.places) or (last["places"] if is_found else []),
    }
