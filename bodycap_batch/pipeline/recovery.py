"""Tasks that look for lost frames once more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bodycap_batch.config.lost_frames import LEAST_LOST, LEAST_POSED
from bodycap_batch.config.models import Job
from bodycap_batch.pipeline.inputs import beside_others, key_of
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks import read_summary


def recovery_tasks(
    job: Job,
    digests: Mapping[str, str],
    scene: Artefact,
    keyframes: Mapping[str, Artefact],
    registrations: Mapping[str, Artefact],
) -> Iterator[Task]:
    """One task for every camera that was lost in some frames and has poses in others.

    Args:
        job: A resolved job.
        digests: Of what each camera's frames are.
        scene: The map.
        keyframes: Of every camera.
        registrations: Of every camera.
    """
    options = job.registration.model_dump(mode="json", exclude={"rounds"})
    for own in job.capture.cameras:
        summary = read_summary(registrations[own.name].path)
        if not LEAST_POSED <= summary["localised"] <= summary["frames"] - LEAST_LOST:
            continue
        ordered = (own, *(camera for camera in job.capture.cameras if camera.name != own.name))
        inputs, arguments = beside_others(job.capture, ordered, digests, scene, keyframes, registrations)
        yield Task(key=key_of("recover", options, inputs), arguments=arguments, camera=own.name)
