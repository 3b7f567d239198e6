"""The results of a job's stages, as far as the job came; the report and the preview are made from them."""

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
    """The artefacts of a job's stages. `run_stages` fills them in one after another.

    Attributes:
        stage: The stage that runs, or ran last.
        keyframes: By camera name.
        map: The map.
        registrations: By camera name.
        merged: The skeleton's motion.
        exported: The result files.
        reported: The report.
        preview: The video of the results, while it is rendered beside later stages.
        previewed: The video of the results.
        failure: Why the results have no skeleton.
    """

    stage: str = "check"
    keyframes: Mapping[str, Artefact] = field(default_factory=dict)
    map: Artefact | None = None
    registrations: Mapping[str, Artefact] = field(default_factory=dict)
    merged: Artefact | None = None
    exported: Artefact | None = None
    reported: Artefact | None = None
    preview: Future[Artefact] | None = None
    previewed: Artefact | None = None
    failure: EstimationError | None = None

    def describe_failure(self, error: BodycapError | None) -> dict[str, Any] | None:
        """Return an error and the stage that it stopped, as the report shows them; None without an error."""
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
        results: Its results, as far as it came.
        cameras: Digest of each camera by name; empty if a video cannot be read.
        digests: Digests of files.
        failure: What stopped the job, see `StageResults.describe_failure`.
    """
    with_body = has_body(job) and results.merged is not None
    return ReportTask(
        name=job.name,
        failure=failure,
        max_gap_s=job.merge.max_gap_s,
        capture=capture_ref(job.capture, cameras),
        keyframes=refs_by_camera(results.keyframes),
        registrations=refs_by_camera(results.registrations),
        map=optional_ref(results.map),
        merge=optional_ref(results.merged),
        export=optional_ref(results.exported),
        body=body_input(job, digests) if with_body else None,
    )


def preview_task(
    job: Job, results: StageResults, scene_map: Artefact, cameras: Mapping[str, str]
) -> PreviewTask:
    """Return the task that renders the results as a video.

    Args:
        job: The job.
        results: Its results up to the merge.
        scene_map: The map.
        cameras: Digest of each camera by name.
    """
    return PreviewTask(
        capture=capture_ref(job.capture, cameras),
        keyframes=refs_by_camera(results.keyframes),
        registrations=refs_by_camera(results.registrations),
        map=artefact_ref(scene_map),
        merge=optional_ref(results.merged),
        failure=None if results.failure is None else results.failure.message,
    )
