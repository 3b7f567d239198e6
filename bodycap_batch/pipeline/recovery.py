"""Tasks that look for lost frames once more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bodycap_batch.config.models import Job
from bodycap_batch.pipeline.inputs import all_cameras, content_of, key_of
from bodycap_batch.runner import Task
from bodycap_batch.store import Artefact
from bodycap_batch.tasks import read_summary

_LEAST_LOST, _LEAST_POSED = 3, 20
"""Fewer lost frames are not worth decoding the keyframes of all cameras again; from fewer frames with poses
nobody knows how the camera moves."""


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
        if not _LEAST_POSED <= summary["localised"] <= summary["frames"] - _LEAST_LOST:
            continue
        ordered = (own, *(camera for camera in job.capture.cameras if camera.name != own.name))
        found = {camera.name: registrations[camera.name] for camera in ordered}
        inputs = {
            "cameras": [digests[camera.name] for camera in ordered],
            "map": scene.digest,
            "keyframes": keyframes[own.name].digest,
            "registrations": list(content_of(found).values()),
        }
        arguments = {
            "capture": all_cameras(job.capture.model_copy(update={"cameras": ordered})),
            "map": str(scene.path),
            "selection": str(keyframes[own.name].path),
            "registrations": [str(artefact.path) for artefact in found.values()],
        }
        yield Task(key=key_of("recover", options, inputs), arguments=arguments, camera=own.name)
