"""The state of a run: the results of its finished stages. The report and the preview are made from them."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field

from bodycap_batch.core.errors import BodycapError, EstimationError
from bodycap_batch.pipeline.inputs import (
    artefact_ref,
    body_input,
    capture_ref,
    has_body,
    optional_ref,
    refs_by_camera,
)
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.tasks.preview import PreviewTask
from bodycap_batch.tasks.report import ReportTask


@dataclass(slots=True)
class StageResults:
    """The artefacts of a job's stages. `run_stages` sets the field of a stage after the stage has finished.

    This is the only state of a run. The functions of `flow` read it; only `check` writes to it, too.

    Attributes:
        facts: The job, and what is known about its videos.
        stage: Name of the running stage, or of the last stage that ran.
        sound: The future of the comparison of the sound, which runs beside the keyframes; None before the
            check, or if there is only one camera.
        keyframes: The artefact of each camera's keyframes, by camera name.
        map: The artefact of the map.
        map_round: Round of the map, counted from 0: how often it was extended and refined.
        registrations: The registration of each camera after all further steps, by camera name.
        links: What the tracks of each camera's video show about its paths, by camera name.
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

    facts: JobFacts
    stage: str = "check"
    sound: Future[Artefact] | None = None
    keyframes: Mapping[str, Artefact] = field(default_factory=dict)
    map: Artefact | None = None
    map_round: int = 0
    registrations: Mapping[str, Artefact] = field(default_factory=dict)
    links: Mapping[str, Artefact] = field(default_factory=dict)
    clocks: Artefact | None = None
    merged: Artefact | None = None
    filled: Artefact | None = None
    exported: Artefact | None = None
    reported: Artefact | None = None
    preview: Future[Artefact] | None = None
    previewed: Artefact | None = None
    failure: EstimationError | None = None

    @property
    def scene_map(self) -> Artefact:
        """The artefact of the map, in the stages after it."""
        assert self.map is not None
        return self.map

    def take_paths(self, other: StageResults) -> None:
        """Replace all up to the final paths of the cameras by the results of another run of these stages."""
        self.facts, self.failure = other.facts, other.failure
        self.keyframes, self.map, self.clocks = other.keyframes, other.map, other.clocks
        self.registrations, self.links = other.registrations, other.links


def report_task(results: StageResults, digests: FileDigests, stopped_by: BodycapError | None) -> ReportTask:
    """Return the task that writes the report.

    Args:
        results: The results of the stages that the job has finished.
        digests: Cache of the digests of files.
        stopped_by: The error that stopped the job; None if the job was not stopped.
    """
    job, error = results.facts.job, stopped_by or results.failure
    with_body = has_body(job) and results.filled is not None
    return ReportTask(
        name=job.name,
        failure=None if error is None else {"stage": results.stage, **error.to_dict()},
        max_gap_s=job.merge.max_gap_s,
        capture=capture_ref(job.capture, results.facts.digests),
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


def preview_task(results: StageResults) -> PreviewTask:
    """Return the task that renders the results of the job's stages up to the merge as a video."""
    assert results.clocks is not None
    return PreviewTask(
        capture=capture_ref(results.facts.job.capture, results.facts.digests),
        keyframes=refs_by_camera(results.keyframes),
        registrations=refs_by_camera(results.registrations),
        map=artefact_ref(results.scene_map),
        clocks=artefact_ref(results.clocks),
        merge=optional_ref(results.filled),
        failure=None if results.failure is None else results.failure.message,
    )
