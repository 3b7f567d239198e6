"""The task that writes the page a person reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.inputs import ArtefactRef, BodyInput, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import RESULTS_FOLDER, VISION_LIBRARIES, VISION_MODULES, Stage

if TYPE_CHECKING:
    from bodycap_batch.capture import Capture
    from bodycap_batch.model.merge_data import MergeResult
    from bodycap_batch.report import ReportInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportTask:
    """Write the page that reports what a job computed.

    Attributes:
        name: The job's name.
        failure: The error that stopped the job (``BodycapError.to_dict``) and the stage; None if nothing did.
        max_gap_s: Gaps between two measurements up to this long were filled.
        capture: All cameras.
        keyframes: By camera; empty if the job did not come that far.
        registrations: By camera; empty if the job did not come that far.
        map: The map; None if the job did not come that far.
        merge: The skeleton's motion; None if there is none.
        export: The results; None if the job did not come that far.
        body: The body; None without a motion.
    """

    name: str
    failure: Mapping[str, Any] | None
    max_gap_s: float
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    registrations: Mapping[str, ArtefactRef]
    map: ArtefactRef | None
    merge: ArtefactRef | None
    export: ArtefactRef | None
    body: BodyInput | None


def run_report(task: ReportTask, context: StageContext, files: Path) -> None:
    """Write the page."""
    from bodycap_batch.report import REPORT_FILE, write_report

    write_report(load_inputs(task, context.threads), files / RESULTS_FOLDER / REPORT_FILE, context)


def load_inputs(task: ReportTask, threads: int = 0) -> ReportInputs:
    """Read the stored results of a job, as far as there are any.

    Args:
        task: The results.
        threads: Threads of each video decoder; 0 lets the decoder choose.
    """
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.merge_data import CameraClock
    from bodycap_batch.report import ReportInputs

    paths = paths_of(task.registrations.values())
    registrations = [load_registration(path) for path in paths]
    return ReportInputs(
        name=task.name,
        cameras=tuple(camera.name for camera in task.capture.config.cameras),
        maps=() if task.map is None else load_map(task.map.path).maps,
        registrations=tuple(registrations),
        clocks={
            found.trajectory.camera: read_dataclass(CameraClock, path, "clock")
            for path, found in zip(paths, registrations, strict=True)
        },
        selections=tuple(load_keyframes(artefact.path) for artefact in task.keyframes.values()),
        merge=_load_merge(task.merge),
        mounts=() if task.body is None else load_body(task.body)[1],
        metrics=None
        if task.export is None
        else json.loads((task.export.path / RESULTS_FOLDER / "metrics.json").read_text(encoding="utf-8")),
        capture=_open_capture(task, threads),
        failure=task.failure,
        max_gap_s=task.max_gap_s,
    )


def _load_merge(merge: ArtefactRef | None) -> MergeResult | None:
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.merge_data import MergeResult

    return None if merge is None else read_dataclass(MergeResult, merge.path, "merge")


def _open_capture(task: ReportTask, threads: int) -> Capture | None:
    """Open the videos; return None if they cannot be read and the job failed, perhaps because of them."""
    from bodycap_batch.core.errors import CaptureError

    try:
        return load_capture(task.capture, task.keyframes, threads=threads)
    except CaptureError:
        if task.failure is None:
            raise
        return None


REPORT = Stage(
    name="report",
    task=ReportTask,
    function=run_report,
    libraries=(*VISION_LIBRARIES, "jinja2", "k3d", "pycolmap", "scipy"),
    modules=(*VISION_MODULES, "bodycap_batch.report", "jinja2", "pycolmap", "scipy.spatial.transform"),
)
