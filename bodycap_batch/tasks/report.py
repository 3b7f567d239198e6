"""The task that writes the report: an HTML page for the user."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.capture import Capture
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.dataclass_files import read_dataclass
from bodycap_batch.model.camera_clock import CaptureClocks, FrameTiming
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.inputs import ArtefactRef, BodyInput, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_clocks, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.motion import load_motion
from bodycap_batch.tasks.stage import RESULTS_FOLDER

if TYPE_CHECKING:
    from bodycap_batch.report import ReportInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportTask:
    """Write the page that reports what a job computed.

    Attributes:
        name: The job's name.
        failure: The error that stopped the job (``BodycapError.to_dict``) and the stage where it occurred;
            None if the job was not stopped.
        max_gap_s: Maximum time (seconds) between two successive poses of a camera. In a longer gap, merging
            marks the motion as filled.
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name; empty if the stage `keyframes` did
            not finish.
        registrations: The registration of each camera, by camera name; empty if the stage `registration` did
            not finish.
        clocks: The clocks of all cameras; None if they are not determined.
        map: The map; None if mapping did not finish.
        merge: The skeleton's motion; None if there is no motion.
        export: The result files; None if the export did not finish.
        body: The body; None if there is no motion.
        places_from_motion: Place of each camera whose place the run found from the motion, by camera name.
    """

    name: str
    failure: Mapping[str, Any] | None
    max_gap_s: float
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    registrations: Mapping[str, ArtefactRef]
    clocks: ArtefactRef | None
    map: ArtefactRef | None
    merge: ArtefactRef | None
    export: ArtefactRef | None
    body: BodyInput | None
    places_from_motion: Mapping[str, str]


def run_report(task: ReportTask, context: StageContext, files: Path) -> None:
    """Write the report."""
    from bodycap_batch.report import REPORT_FILE, write_report

    write_report(load_inputs(task, context.threads), files / RESULTS_FOLDER / REPORT_FILE, context)


def load_inputs(task: ReportTask, threads: int = 0) -> ReportInputs:
    """Read the stored results of a job; results of stages that did not finish are missing.

    Args:
        task: The report's task, which names the stored results.
        threads: Number of threads of each video decoder; 0 lets the decoder choose.
    """
    from bodycap_batch.report import ReportInputs

    paths = paths_of(task.registrations.values())
    registrations = [load_registration(path) for path in paths]
    timings = {
        found.trajectory.camera: read_dataclass(FrameTiming, path, "timing")
        for path, found in zip(paths, registrations, strict=True)
    }
    clocks = CaptureClocks(reference="") if task.clocks is None else load_clocks(task.clocks.path)
    maps = () if task.map is None else load_map(task.map.path).maps
    return ReportInputs(
        name=task.name,
        cameras=tuple(camera.name for camera in task.capture.config.cameras),
        maps=maps,
        registrations=tuple(registrations),
        clocks=clocks.with_timing(timings),
        reference_camera=clocks.reference,
        selections=tuple(load_keyframes(artefact.path) for artefact in task.keyframes.values()),
        merge=None if task.merge is None else load_motion(task.merge),
        mounts=() if task.body is None else load_body(task.body)[1],
        metrics=None
        if task.export is None
        else json.loads((task.export.path / RESULTS_FOLDER / "metrics.json").read_text(encoding="utf-8")),
        capture=_open_capture(task, clocks, threads),
        failure=task.failure,
        max_gap_s=task.max_gap_s,
        places_from_motion=task.places_from_motion,
        files=() if task.export is None else _result_files(task.export),
    )


def _result_files(export: ArtefactRef) -> tuple[str, ...]:
    """Return the paths of the result files of the export, relative to the results folder."""
    folder = export.path / RESULTS_FOLDER
    return tuple(sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()))


def _open_capture(task: ReportTask, clocks: CaptureClocks, threads: int) -> Capture | None:
    """Open the videos of a job.

    Returns:
        The capture. None if the videos cannot be read and the job has failed: the unreadable videos may be
        the cause of the failure.

    Raises:
        CaptureError: The videos cannot be read, but the job has not failed.
    """
    try:
        return load_capture(task.capture, task.keyframes, clocks=clocks, threads=threads)
    except CaptureError:
        if task.failure is None:
            raise
        return None
