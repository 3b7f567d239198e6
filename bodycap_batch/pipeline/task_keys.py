"""Create the tasks of the runner and the keys of the store from the typed tasks of the stages."""

from __future__ import annotations

from bodycap_batch.core.mechanisms import KEY_OPTION, switched_off
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import ArtefactKey
from bodycap_batch.store.code_version import Program
from bodycap_batch.tasks.stage import Stage, TaskT
from bodycap_batch.tasks.typed_json import key_inputs, key_options, to_json


def make_task(
    stage: Stage[TaskT], task: TaskT, *, camera: str = "", map_round: int = 0, threads: int = 1
) -> Task:
    """Return the runner's task for a typed task of a stage.

    Args:
        stage: The stage.
        task: The typed task: its options and inputs.
        camera: Name of the camera that the task concerns; "" if it concerns no single camera.
        map_round: Round of the map, counted from 0.
        threads: Number of threads that the task may keep busy.
    """
    return Task(
        key=artefact_key(stage, task),
        arguments=to_json(task),
        program=program_of(stage),
        camera=camera,
        round=map_round,
        threads=threads,
        modules=stage.modules,
        memory_mb=stage.memory_mb,
    )


def artefact_key(stage: Stage[TaskT], task: TaskT) -> ArtefactKey:
    """Return the key under which the store holds the result of a typed task."""
    algorithm, libraries = program_of(stage).versions()
    return ArtefactKey(
        stage=stage.name,
        algorithm=algorithm,
        options=_options(task),
        inputs=key_inputs(task),
        libraries=libraries,
    )


def _options(task: object) -> dict[str, object]:
    """Return the options of a task for its key, and the mechanisms that are switched off."""
    off = sorted(item.value for item in switched_off())
    return {**key_options(task), **({KEY_OPTION: off} if off else {})}


def program_of(stage: Stage[TaskT]) -> Program:
    """Return the code that computes the results of a stage."""
    return Program(stage.module, stage.libraries)
