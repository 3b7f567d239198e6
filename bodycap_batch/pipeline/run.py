"""`run_job`: the stages in order, on one screen."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

import bodycap_batch
from bodycap_batch.config.folder import RUN_FILE
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import BodycapError, Cancelled, CaptureError, EstimationError, JobError
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.made import Made
from bodycap_batch.pipeline.results import (
    PARTIAL,
    clear_partial,
    publish,
    remove_outdated,
    write_results_file,
)
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks import ORDER, RESULTS

JOB_FILE = "job.yaml"
REPORT_FILE = "report.html"


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
        out_dir: Folder of the results; what an earlier run left there stays until this one has results, which
            is before their video is made.
        settings: Store, threads, listener, cancellation.

    Raises:
        BodycapError: A stage failed. Where the skeleton could not be solved, the map, the cameras' paths
            and the frames are in ``<out_dir>/partial``. Where it was the report or the video, the other
            results are there.
    """
    settings.store.sweep()
    settings.require_owner()
    made, whole = Made(), settings.until in ("", ORDER[-1])
    with Flow(job, settings, logs=out_dir / "logs") as flow:
        stopped_by = _run_until(job, flow, made, out_dir, settings)
        summary = _summary(flow, made, out_dir)
        if whole and made.exported is not None:
            place = _hand_over(job, flow, made, out_dir, settings)
            if stopped_by is not None:
                _add_hint(stopped_by, f"the other results are in {place}")
            if made.failure is None:
                flow.keep_only_this()
        elif stopped_by is not None:
            _tell_how_far(flow, made, stopped_by, out_dir, settings)
    if (error := _first_of(made.failure, stopped_by)) is not None:
        raise error
    return summary if whole else replace(summary, files=())


def run_stages(job: Job, flow: Flow, made: Made) -> Iterator[str]:
    """Run one stage after another; yields the name of each when it is done."""
    flow.check()
    yield "check"
    made.stage = "keyframes"
    made.keyframes = flow.keyframes()
    yield "keyframes"
    made.stage = "map"
    made.scene = scene = flow.map(made.keyframes)
    yield "map"
    made.stage = "registration"
    made.registrations = found = flow.registrations(scene, made.keyframes)
    scene, found = flow.grow(scene, found, made.keyframes)
    made.scene, found = flow.refine(scene, found, made.keyframes)
    found = flow.solve_rigs(made.scene, found, made.keyframes)
    made.registrations = flow.recover(made.scene, found, made.keyframes)
    yield "registration"
    made.stage = "merge"
    made.merged, made.failure = _merge(job, flow, made)
    yield "merge"
    made.filming = flow.start_preview(made) if job.export.preview else None
    made.exported = flow.export(made.keyframes, made.scene, made.registrations, made.merged, made.failure)
    yield "export"
    made.reported = flow.report(made)
    yield "report"
    if made.filming is not None:
        made.previewed = made.filming.result()
        yield "preview"


def _run_until(job: Job, flow: Flow, made: Made, out_dir: Path, settings: Settings) -> BodycapError | None:
    """Run the stages up to the last one wanted; returns what stopped them, if a report can tell of it.

    The results do not wait for their video.
    """
    try:
        for stage in run_stages(job, flow, made):
            if stage == settings.until:
                break
            if stage == "report" and made.filming is not None and not made.filming.done():
                settings.results_ready(_hand_over(job, flow, made, out_dir, settings))
    except BodycapError as error:
        # Results that are there are handed over although the page about them could not be written.
        tellable = made.exported is not None or isinstance(error, JobError | CaptureError | EstimationError)
        if isinstance(error, Cancelled) or not tellable:
            raise
        return error
    return None


def _first_of(failure: EstimationError | None, stopped_by: BodycapError | None) -> BodycapError | None:
    """What a job ends with: that there is no skeleton, unless the machine failed; the other is its hint."""
    if failure is None or stopped_by is None:
        return failure or stopped_by
    of_data = isinstance(stopped_by, JobError | CaptureError | EstimationError)
    first, second = (failure, stopped_by) if of_data else (stopped_by, failure)
    _add_hint(first, f"besides: {second.message}")
    return first


def _tell_how_far(flow: Flow, made: Made, error: BodycapError, out_dir: Path, settings: Settings) -> None:
    """Publish the report of a job that broke off before there were results."""
    try:
        made.reported = flow.report(made, error)
        settings.require_owner()
        publish(dict(files_of(made.reported)), out_dir / PARTIAL)
    except BodycapError as another:
        error.add_note(f"and its report could not be written: {another.message}")
        return
    _add_hint(error, f"how far it came: {out_dir / PARTIAL / REPORT_FILE}")


def _add_hint(error: BodycapError, text: str) -> None:
    """Say one thing more, once."""
    if text not in (error.hint or ""):
        error.hint = f"{error.hint}; {text}" if error.hint else text


def _summary(flow: Flow, made: Made, out_dir: Path) -> RunSummary:
    """What is there by now."""
    return RunSummary(
        out_dir=out_dir, files=tuple(_results(made)), stages=tuple(flow.records), versions=_versions(flow)
    )


def _hand_over(job: Job, flow: Flow, made: Made, out_dir: Path, settings: Settings) -> Path:
    """Publish the results and return their folder; those without a skeleton are set apart, called partial."""
    settings.require_owner()
    if made.failure is None:
        _finish(job, made, _summary(flow, made, out_dir), settings)
        clear_partial(out_dir)
        return out_dir
    partial = out_dir / PARTIAL
    _finish(job, made, _summary(flow, made, partial), settings)
    _add_hint(made.failure, f"the map, the cameras' paths and the frames are in {partial}")
    return partial


def _merge(job: Job, flow: Flow, made: Made) -> tuple[Artefact | None, EstimationError | None]:
    """The skeleton, or the reason why the data did not support one."""
    if not has_body(job) or made.scene is None:
        return None, None
    try:
        return flow.merge(made.scene, made.registrations, made.keyframes), None
    except EstimationError as error:
        return None, error


def _finish(job: Job, made: Made, summary: RunSummary, settings: Settings) -> None:
    """Results first, then the record of the run, so that the record never speaks of what is not there."""
    out_dir = summary.out_dir
    publish(_results(made), out_dir)
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


def files_of(artefact: Artefact) -> list[tuple[str, Path]]:
    """Name in the results' folder and file in the store of each file meant for the user."""
    return [
        (Path(name).relative_to(RESULTS).as_posix(), artefact.path / name)
        for name in artefact.files
        if name.startswith(f"{RESULTS}/")
    ]


def _results(made: Made) -> dict[str, Path]:
    """All files that go to the user."""
    parts = (made.exported, made.reported, made.previewed)
    return {name: path for part in parts if part is not None for name, path in files_of(part)}
