"""Which stages of a job would run, and why."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import Job
from bodycap_batch.core.progress import task_label
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.made import Made
from bodycap_batch.pipeline.run import run_stages
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.store.artefacts import MANIFEST, Store
from bodycap_batch.tasks import ORDER

_INPUTS = {
    "camera": "its video, calibration, clock or window",
    "cameras": "the video, calibration, clock or window of {}",
    "keyframes": "the keyframes of {}",
    "registrations": "the poses of {}",
    "body": "the body: {}",
    "extra": "the frames wanted of {}",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One stage of a job.

    Attributes:
        stage: Name, camera and round as one reads them.
        stored: True where it would be taken from the store.
        reason: Why it would run.
    """

    stage: str
    stored: bool
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The step as plain JSON values."""
        return asdict(self)


def explain_job(job: Job, *, out_dir: Path, settings: Settings) -> list[Step]:
    """List a job's stages in order: those stored, those that would run and what has changed.

    Nothing is computed. Behind the first stage that would run, all stages run: their inputs are new.

    Raises:
        BodycapError: The job's files cannot be read, or the disk fails.
    """
    looking = replace(settings, compute=False)
    missing: tuple[Task, ...] = ()
    made = Made()
    with Flow(job, looking, logs=out_dir / "logs") as flow:
        try:
            for _ in run_stages(job, flow, made):
                pass
        except NotStored as error:
            beside = [task for task in _preview_missing(made) if task not in error.tasks]
            missing = (*error.tasks, *beside)
        records = tuple(flow.records)
    steps = [
        Step(stage=task_label(item.stage, item.camera, item.round), stored=True)
        for item in sorted(records, key=lambda item: (item.round, _place(item.stage)))
    ]
    steps += [Step(stage=task.label, stored=False, reason=_reason(task, settings.store)) for task in missing]
    if missing:
        after = _place(missing[0].key.stage)
        first = missing[0].key.stage
        later = [name for name in ORDER if _place(name) > after and _follows(name, first, job)]
        steps += [Step(stage=name, stored=False, reason=f"after {first}") for name in later]
    return steps


def _preview_missing(made: Made) -> Sequence[Task]:
    """The preview's task where it would run: it is looked up beside the export and the report."""
    if made.filming is None:
        return ()
    failure = made.filming.exception()
    return failure.tasks if isinstance(failure, NotStored) else ()


def _follows(stage: str, first: str, job: Job) -> bool:
    """Whether a job has a later stage, and whether that stage uses what the first one gives."""
    if stage == "preview":
        return job.export.preview and first not in ("export", "report")
    return stage != "merge" or has_body(job)


def _place(stage: str) -> int:
    """Where in a job's order a stage stands; the map's growth belongs to registration."""
    return ORDER.index(stage if stage in ORDER else "registration")


def _reason(task: Task, store: Store) -> str:
    """What distinguishes a task from the most similar artefact of its stage."""
    wanted = dict(_flat(task.key.document()))
    if any((store.root / "corrupt").glob(f"{task.key.stage}-{task.key.name}-*")):
        return "its stored result was damaged"
    nearest: list[str] | None = None
    for path in sorted((store.root / "artefacts" / task.key.stage).glob(f"*/{MANIFEST}")):
        known = dict(_flat(_key_in(path)))
        changes = [
            name
            for name in sorted({*wanted, *known})
            if wanted.get(name, _ABSENT) != known.get(name, _ABSENT)
        ]
        if changes and (nearest is None or len(changes) < len(nearest)):
            nearest, was = changes, known
    if nearest is None:
        return "not computed before"
    return "; ".join(dict.fromkeys(_change(name, was, wanted) for name in nearest))


_ABSENT = object()


def _key_in(path: Path) -> Mapping[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["key"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every leaf; a list is one value."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _flat(part, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.loads(json.dumps(value))


def _change(name: str, was: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    kind, _, rest = name.partition(".")
    if kind == "options":
        return f"{rest}: {_said(was, name)} -> {_said(now, name)}"
    if kind == "algorithm":
        return "the program has changed"
    if kind == "libraries":
        return f"{rest} {_said(was, name)} -> {_said(now, name)}"
    what, _, which = rest.partition(".")
    return f"{_INPUTS.get(what, f'the {what}').format(which or 'a camera')} changed"


def _said(values: Mapping[str, Any], name: str) -> str:
    return json.dumps(values[name], ensure_ascii=False) if name in values else "nothing"
