"""`run_job`: the stages in order, on one screen."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

import bodycap_batch
from bodycap_batch.config.models import Job
from bodycap_batch.errors import EstimationError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.results import (
    PARTIAL,
    RUN_FILE,
    clear_partial,
    publish,
    remove_outdated,
    write_results_file,
)
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.store import Artefact
from bodycap_batch.tasks import RESULTS

JOB_FILE = "job.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """What a finished job left behind.

    Attributes:
        out_dir: Folder of the results.
        files: Their names, relative to it; none where the run ended before.
        stages: Every stage that went into them, executed or reused.
        versions: Python, this program and the libraries that computed.
    """

    out_dir: Path
    files: tuple[str, ...]
    stages: tuple[StageRecord, ...]
    versions: Mapping[str, str]

    @property
    def executed(self) -> int:
        """How many stages had to be computed."""
        return sum(not stage.reused for stage in self.stages)


def run_job(job: Job, *, out_dir: Path, settings: Settings) -> RunSummary:
    """Take a job through all stages; whatever the store already holds is not computed again.

    Args:
        job: A resolved job.
        out_dir: Folder of the results; what an earlier run left there stays until this one succeeds.
        settings: Store, threads, listener, cancellation.

    Raises:
        BodycapError: A stage failed. Where the skeleton could not be solved, the map, the cameras' paths
            and the frames are in ``<out_dir>/partial``.
    """
    settings.store.sweep()
    settings.require_owner()
    made = Made()
    with Flow(job, settings, logs=out_dir / "logs") as flow:
        for stage in run_stages(job, flow, made):
            if stage == settings.until:
                break
        summary = RunSummary(out_dir=out_dir, files=(), stages=tuple(flow.records), versions=_versions(flow))
        if made.results:
            files = tuple(name for name, _ in _result_files(made.results))
            summary = replace(summary, files=files)
            settings.require_owner()
            _hand_over(job, made, summary, settings)
            if made.failure is None:
                flow.keep_only_this()
    if made.failure is not None:
        raise made.failure
    return summary


@dataclass(slots=True)
class Made:
    """What the stages gave: the artefacts with results, and why there is no skeleton among them."""

    results: tuple[Artefact, ...] = ()
    failure: EstimationError | None = None


def run_stages(job: Job, flow: Flow, made: Made) -> Iterator[str]:
    """Run one stage after another; yields the name of each when it is done."""
    flow.check()
    yield "check"
    keyframes = flow.keyframes()
    yield "keyframes"
    scene = flow.map(keyframes)
    yield "map"
    registrations = flow.registrations(scene, keyframes)
    scene, registrations = flow.grow(scene, registrations, keyframes)
    scene, registrations = flow.refine(scene, registrations, keyframes)
    yield "registration"
    merged, made.failure = _merge(job, flow, scene, registrations)
    yield "merge"
    made.results = (flow.export(keyframes, scene, registrations, merged, made.failure),)
    yield "export"
    if job.export.preview:
        made.results += (flow.preview(scene, registrations, merged, made.failure),)
        yield "preview"


def _hand_over(job: Job, made: Made, summary: RunSummary, settings: Settings) -> None:
    """Publish the results; those without a skeleton are set apart and called partial."""
    if made.failure is None:
        _finish(job, made.results, summary, settings)
        clear_partial(summary.out_dir)
        return
    partial = summary.out_dir / PARTIAL
    _finish(job, made.results, replace(summary, out_dir=partial), settings)
    kept = f"the map, the cameras' paths and the frames are in {partial}"
    made.failure.hint = f"{made.failure.hint}; {kept}" if made.failure.hint else kept


def _merge(
    job: Job, flow: Flow, scene: Artefact, registrations: Mapping[str, Artefact]
) -> tuple[Artefact | None, EstimationError | None]:
    """The skeleton, or the reason why the data did not support one."""
    if not has_body(job):
        return None, None
    try:
        return flow.merge(scene, registrations), None
    except EstimationError as error:
        return None, error


def _finish(job: Job, results: Sequence[Artefact], summary: RunSummary, settings: Settings) -> None:
    """Results first, then the record of the run, so that the record never speaks of what is not there."""
    out_dir = summary.out_dir
    publish(dict(_result_files(results)), out_dir)
    resolved = yaml.safe_dump(
        job.model_dump(mode="json", exclude_none=True), sort_keys=False, allow_unicode=True
    )
    write_results_file(out_dir, JOB_FILE, resolved)
    remove_outdated(out_dir, summary.files)
    record = {
        "versions": dict(summary.versions),
        "threads": settings.threads,
        "seconds": round(sum(stage.seconds for stage in summary.stages), 3),
        "peak_memory_mb": max((stage.peak_memory_mb for stage in summary.stages), default=0.0),
        "stages": [asdict(stage) for stage in summary.stages],
        "files": list(summary.files),
    }
    write_results_file(out_dir, RUN_FILE, json.dumps(record, indent=1) + "\n")


def _versions(flow: Flow) -> dict[str, str]:
    own = {"bodycap_batch": bodycap_batch.__version__, "python": platform.python_version()}
    return {**own, **dict(sorted(flow.libraries.items()))}


def _result_files(artefacts: Sequence[Artefact]) -> list[tuple[str, Path]]:
    """Name in the results' folder and file in the store of each file that goes to the user."""
    return [
        (Path(name).relative_to(RESULTS).as_posix(), artefact.path / name)
        for artefact in artefacts
        for name in artefact.files
        if name.startswith(f"{RESULTS}/")
    ]
