"""Tasks that solve the cameras of a rig together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from bodycap_batch.config.models import CaptureConfig, Job
from bodycap_batch.pipeline.inputs import beside_others, key_of
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import Artefact


def segments_of(capture: CaptureConfig) -> list[list[str]]:
    """Names of the cameras on each segment that carries several."""
    return [[camera.name for camera in cameras] for cameras in capture.segments()]


def rig_tasks(
    job: Job,
    digests: Mapping[str, str],
    scene: Artefact,
    keyframes: Mapping[str, Artefact],
    registrations: Mapping[str, Artefact],
) -> Iterator[Task]:
    """One task for every camera of a synchronised rig.

    Args:
        job: A resolved job.
        digests: Of what each camera's frames are.
        scene: The map.
        keyframes: Of every camera.
        registrations: Of every camera.
    """
    options = job.registration.model_dump(mode="json", exclude={"rounds"})
    segments = job.capture.segments() if job.capture.rig == "synced" else []
    for own, cameras in ((own, segment) for segment in segments for own in segment):
        ordered = (own, *(camera for camera in cameras if camera.name != own.name))
        inputs, arguments = beside_others(job.capture, ordered, digests, scene, keyframes, registrations)
        yield Task(key=key_of("rig", options, inputs), arguments=arguments, camera=own.name)
