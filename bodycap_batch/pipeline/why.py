"""List the stages of a job that would run, and the reason for each stage."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import Job
from bodycap_batch.core.progress import task_label
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.run import run_stages
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.stage_results import StageResults
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.store.artefacts import MANIFEST, Artefact, Store
from bodycap_batch.tasks.order import STAGE_ORDER
from bodycap_batch.tasks.stages import STAGES

_INPUTS = {
    "capture": "the video, the calibration, start_s or end_s of {}",
    "cameras": "the video, the calibration, start_s or end_s of {}",
    "clocks": "the clock of {}",
    "stated": "the clock or the place of {}",
    "keyframes": "the keyframes of {}",
    "registrations": "the poses of {}",
    "body": "the body: {}",
    "extra": "the extra keyframes of {}",
}
"""Description of a changed part of an input, by the name of the input's field in the task's dataclass. ``{}``
is replaced by the name of the part."""
_WHOLE_INPUTS = {
    "footage": "the search for the marker board",
    "common": "capture.clocks",
    "merge": "the motion",
    "previous": "the result of the previous round",
    "places_from_motion": "the places found from the motion",
    "reach": "the distances between the cameras",
}
"""Description of an input as a whole, by the name of the input's field. Every other input is described by the
name of its field."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One task of a job.

    Attributes:
        stage: Label of the task for messages: stage, camera and round.
        stored: True if the store holds the task's result.
        reason: The reason why the task would run; "" if its result is stored.
    """

    stage: str
    stored: bool
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the step as plain JSON values."""
        return asdict(self)


def explain_job(job: Job, *, out_dir: Path, settings: Settings) -> list[Step]:
    """List a job's tasks: first the tasks with stored results, then the tasks that would run, and why.

    Nothing is computed. The later stages that depend on a task that would run are listed too.

    Raises:
        BodycapError: The job's files cannot be read, or the disk fails.
    """
    missing: tuple[Task, ...] = ()
    results = StageResults(facts=JobFacts.of(job))
    with StageRunner.of(job, replace(settings, compute=False), out_dir) as runner:
        try:
            for _ in run_stages(runner, results):
                pass
        except NotStored as error:
            beside = [*_missing(results.sound), *_missing(results.preview)]
            missing = (*error.tasks, *(task for task in beside if task not in error.tasks))
        records = tuple(runner.records)
    steps = [
        Step(stage=task_label(item.stage, item.camera, item.round), stored=True)
        for item in sorted(records, key=lambda item: (item.round, _position(item.stage)))
    ]
    steps += [Step(stage=task.label, stored=False, reason=_reason(task, settings.store)) for task in missing]
    if missing:
        first = missing[0].key.stage
        after = _position(first)
        # The keyframes may wait for the sound, which runs beside them.
        beside_it = {name for name in STAGE_ORDER if _position(name) == after} - {first}
        waiting = beside_it - {item.stage for item in records}
        later = [
            name
            for name in STAGE_ORDER
            if (_position(name) > after or name in waiting) and _depends_on(name, first, job)
        ]
        steps += [Step(stage=name, stored=False, reason=f"after {first}") for name in later]
    return steps


def _missing(beside: Future[Artefact] | None) -> Sequence[Task]:
    """Return the task that runs beside other stages if its result is not stored; else an empty sequence."""
    failure = None if beside is None else beside.exception()
    return failure.tasks if isinstance(failure, NotStored) else ()


def _depends_on(stage: str, first: str, job: Job) -> bool:
    """Return True if the job includes the stage `stage`, and this stage uses the results of `first`."""
    if stage == "preview":
        return job.export.preview and first not in ("export", "report")
    return stage not in ("merge", "fill") or has_body(job)


def _position(stage: str) -> int:
    """Return the position in `STAGE_ORDER` of a stage, or of the stage of which it is a part."""
    step = STAGES[stage].step
    assert step is not None
    return STAGE_ORDER.index(step)


def _reason(task: Task, store: Store) -> str:
    """Describe why a task's result is not stored.

    The task's key is compared with the most similar key among the stored artefacts of the same stage.
    """
    wanted = dict(_leaves(task.key.document()))
    if any((store.root / "corrupt").glob(f"{task.key.stage}-{task.key.name}-*")):
        return "the stored result of this stage was damaged"
    fewest: list[str] | None = None
    for path in sorted((store.root / "artefacts" / task.key.stage).glob(f"*/{MANIFEST}")):
        stored = dict(_leaves(_stored_key(path)))
        changes = _changed_names(stored, wanted)
        if changes and (fewest is None or len(changes) < len(fewest)):
            fewest, before = changes, stored
    if fewest is None:
        return "this stage has not been computed before"
    return "; ".join(dict.fromkeys(_describe_change(name, before, wanted) for name in fewest))


def _changed_names(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the names of the values that differ between a stored key (`before`) and a task's key (`now`).

    An artefact of another program version may name its inputs differently. In this case, only the names that
    occur in both keys are compared.
    """
    same_program = before.get("algorithm") == now["algorithm"]
    names = {*before, *now} if same_program else {*before} & {*now}
    return [name for name in sorted(names) if before.get(name, _ABSENT) != now.get(name, _ABSENT)]


_ABSENT = object()


def _stored_key(manifest: Path) -> Mapping[str, Any]:
    try:
        return dict(json.loads(manifest.read_text(encoding="utf-8"))["key"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every leaf of nested mappings; a list is treated as one leaf."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _leaves(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.loads(json.dumps(value))


def _describe_change(name: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    kind, _, rest = name.partition(".")
    if kind == "options":
        return f"{rest}: {_value_text(before, name)} -> {_value_text(now, name)}"
    if kind == "algorithm":
        return "the program has changed"
    if kind == "libraries":
        return f"{rest} {_value_text(before, name)} -> {_value_text(now, name)}"
    return _describe_input(*rest.partition(".")[::2], before, now)


def _describe_input(field: str, part: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Describe a changed input.

    An optional input that a task does not use is stored as one leaf with the value None.

    Args:
        field: Name of the input's field in the task's dataclass.
        part: Dotted name of the part that changed; "" if the input has no parts.
        before: The leaves of the stored key.
        now: The leaves of the task's key.
    """
    whole = f"inputs.{field}"
    text = _WHOLE_INPUTS.get(field, f"the {field}")
    if whole in before and before[whole] is None:
        return f"{text} is used now, but was not used before"
    if whole in now and now[whole] is None:
        return f"{text} was used before, but is not used now"
    return f"{_INPUTS[field].format(part) if part and field in _INPUTS else text} changed"


def _value_text(values: Mapping[str, Any], name: str) -> str:
    return json.dumps(values[name], ensure_ascii=False) if name in values else "nothing"
