"""What the stages of a job gave, as far as it came; the report is made of it, the results are part of it."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, EstimationError
from bodycap_batch.pipeline.inputs import all_cameras, body_arguments, content_of, has_body, kept_in, key_of
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import Artefact


@dataclass(slots=True)
class Made:
    """What the stages gave.

    Attributes:
        stage: The stage that runs, or ran last.
        keyframes: By camera name.
        scene: The map.
        registrations: By camera name.
        merged: The skeleton.
        exported: The results.
        reported: The report.
        filming: The results as a video, being made.
        previewed: The results as a video.
        failure: Why there is no skeleton among the results.
    """

    stage: str = "check"
    keyframes: Mapping[str, Artefact] = field(default_factory=dict)
    scene: Artefact | None = None
    registrations: Mapping[str, Artefact] = field(default_factory=dict)
    merged: Artefact | None = None
    exported: Artefact | None = None
    reported: Artefact | None = None
    filming: Future[Artefact] | None = None
    previewed: Artefact | None = None
    failure: EstimationError | None = None

    def failed_at(self, error: BodycapError) -> dict[str, Any]:
        """The error as the report tells it."""
        return {"stage": self.stage, **error.to_dict()}


def report_task(job: Job, made: Made, digests: Mapping[str, str], failure: Mapping[str, Any] | None) -> Task:
    """The task that writes the report of what was made.

    Args:
        job: The job.
        made: As far as it came.
        digests: Of the cameras, by name; none where a video cannot be read.
        failure: What stopped it, None where nothing did.
    """
    single = {"map": made.scene, "merge": made.merged, "export": made.exported}
    many = {"registrations": made.registrations, "keyframes": made.keyframes}
    stated = {"name": job.name, "failure": failure, "max_gap_s": job.merge.max_gap_s}
    body = body_arguments(job) if has_body(job) and made.merged is not None else None
    inputs = {
        **stated,
        "cameras": dict(digests),
        "body": body,
        **{name: None if item is None else item.digest for name, item in single.items()},
        **{name: {camera: item.digest for camera, item in items.items()} for name, items in many.items()},
    }
    arguments = {
        **stated,
        "capture": all_cameras(job.capture),
        "kept": kept_in(made.keyframes),
        "body": body,
        **{name: None if item is None else str(item.path) for name, item in single.items()},
        **{name: [str(item.path) for item in items.values()] for name, items in many.items()},
    }
    return Task(key=key_of("report", {}, inputs), arguments=arguments)


def preview_task(job: Job, made: Made, digests: Mapping[str, str]) -> Task:
    """The task that films what was made.

    Args:
        job: The job.
        made: With a map and what came after it, as far as that came.
        digests: Of the cameras, by name.
    """
    reason = None if made.failure is None else made.failure.message
    single = {"map": made.scene, "merge": made.merged}
    inputs = {
        "cameras": dict(digests),
        "keyframes": content_of(made.keyframes),
        "registrations": content_of(made.registrations),
        **{name: None if item is None else item.digest for name, item in single.items()},
        "failure": reason,
    }
    arguments = {
        "capture": all_cameras(job.capture),
        "kept": kept_in(made.keyframes),
        "registrations": [str(artefact.path) for artefact in made.registrations.values()],
        **{name: None if item is None else str(item.path) for name, item in single.items()},
        "failure": reason,
    }
    return Task(key=key_of("preview", {}, inputs), arguments=arguments)
