"""The results of the stages that a job has finished. The report and the preview are made from them."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, EstimationError
from bodycap_batch.pipeline.inputs import (
    artefact_ref,
    body_input,
    capture_ref,
    has_body,
    optional_ref,
    refs_by_camera,
)
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.tasks.preview import PreviewTask
from bodycap_batch.tasks.report import ReportTask


@dataclass(slots=True)
class StageResults:
    """The artefacts of a job's stages. `run_stages` sets the field of a stage after the stage has finished.

    Attributes:
        stage: Name of the running stage, or of the last stage that ran.
        keyframes: The artefact of each camera's keyframes, by camera name.
        map: The artefact of the map.
        registrations: The registration of each camera after all further steps, by camera name.
        links: What the tracks of each camera's video show about its paths, by camera name.
        job: The job with the places that were found from the motion; None before they are looked for.
        clocks: The artefact of the clocks of all cameras.
        merged: The artefact of the skeleton's motion.
        filled: The artefact of the motion with the joints that no camera measured.
        exported: The artefact of the result files.
        reported: The artefact of the report.
        preview: The future of the artefact with the results' video. The video is rendered while later stages
            run.
        previewed: The artefact of the finished video of the results.
        failure: The reason why the skeleton that the job asks for is missing; None if no skeleton is missing.
    """

    stage: str = "check"
    keyframes: Mapping[str, Artefact] = field(default_factory=dict)
    map: Artefact | None = None
    registrations: Mapping[str, Artefact] = field(default_factory=dict)
    links: Mapping[str, Artefact] = field(default_factory=dict)
    job: Job | None = None
    clocks: Artefact | None = None
    merged: Artefact | None = None
    filled: Artefact | None = None
    exported: Artefact | None = None
    reported: Artefact | None = None
    preview: Future[Artefact] | None = None
    previewed: Artefact | None = None
    failure: EstimationError | None = None

    def describe_failure(self, error: BodycapError | None) -> dict[str, Any] | None:
        """Return an error and the stage that it stopped, as JSON values; None if there is no error."""
        return None if error is None else {"stage": self.stage, **error.to_dict()}


def report_task(
    job: Job,
    results: StageResults,
    cameras: Mapping[str, str],
    digests: FileDigests,
    failure: Mapping[str, Any] | None,
) -> ReportTask:
    """Return the task that writes the report.

    Args:
        job: The job.
        results: The results of the stages that the job has finished.
        cameras: The digest of each camera, by camera name; empty if a video cannot be read.
        digests: Cache of the digests of files.
        failure: The error that stopped the job, from `StageResults.describe_failure`; None without an error.
    """
    job = results.job or job
    with_body = has_body(job) and results.filled is not None
    return ReportTask(
        name=job.name,
        failure=failure,
        max_gap_s=job.merge.max_gap_s,
        capture=capture_ref(job.capture, cameras),
        keyframes=refs_by_camera(results.keyframes),
        registrations=refs_by_camera(results.registrations),
        clocks=optional_ref(results.clocks),
        map=optional_ref(results.map),
        merge=optional_ref(results.filled),
        export=optional_ref(results.exported),
        body=body_input(job, digests) if with_body else None,
        places_from_motion={
            camera.name: str(camera.mount)
            for camera in job.capture.cameras
            if camera.mount_source == "motion"
        },
    )


def preview_task(
    job: Job, results: StageResults, scene_map: Artefact, clocks: Artefact, cameras: Mapping[str, str]
) -> PreviewTask:
    """Return the task that renders the results as a video.

    Args:
        job: The job.
        results: The results of the job's stages up to the merge.
        scene_map: The artefact of the map.
        clocks: The artefact of the clocks of all cameras.
        cameras: The digest of each camera, by camera name.
    """
    job = results.job or job
    return PreviewTask(
        capture=capture_ref(job.capture, cameras),
        keyframes=refs_by_camera(results.keyframes),
        registrations=refs_by_camera(results.registrations),
        map=artefact_ref(scene_map),
        clocks=artefact_ref(clocks),
        merge=optional_ref(results.filled),
        failure=None if results.failure is None else results.failure.message,
    )
