"""Create the tasks of the runner and the keys of the store from the typed tasks of the stages."""

from __future__ import annotations

from bodycap_batch.core.mechanisms import KEY_OPTION, switched_off
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import ArtefactKey
from bodycap_batch.tasks.stages import stage_of
from bodycap_batch.tasks.typed_json import key_inputs, key_options, to_json


def make_task(task: object, *, camera: str = "", map_round: int = 0, threads: int = 1) -> Task:
    """Return the runner's task for a typed task.

    Args:
        task: The typed task of a stage: its options and inputs.
        camera: Name of the camera that the task concerns; "" if it concerns no single camera.
        map_round: Round of the map, counted from 0.
        threads: Number of threads that the task may keep busy.
    """
    stage = stage_of(task)
    return Task(
        key=artefact_key(task),
        arguments=to_json(task),
        program=stage.program,
        camera=camera,
        round=map_round,
        threads=threads,
        modules=stage.modules,
        memory_mb=stage.memory_mb,
    )


def artefact_key(task: object) -> ArtefactKey:
    """Return the key under which the store holds the result of a typed task."""
    stage = stage_of(task)
    algorithm, libraries = stage.program.versions()
    off = sorted(item.value for item in switched_off())
    return ArtefactKey(
        stage=stage.name,
        algorithm=algorithm,
        options={**key_options(task), **({KEY_OPTION: off} if off else {})},
        inputs=key_inputs(task),
        libraries=libraries,
    )
