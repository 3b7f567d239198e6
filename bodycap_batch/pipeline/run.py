"""Run a job: run all stages one after another, and publish the results in the user's folder."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

import bodycap_batch
from bodycap_batch.config.folder import PARTIAL, RUN_FILE
from bodycap_batch.config.models import Job
from bodycap_batch.config.overrides import COMMAND_LINE, values_to_record
from bodycap_batch.config.path_bounds import MAX_CONTRADICTED
from bodycap_batch.core.errors import (
    BodycapError,
    Cancelled,
    CaptureError,
    EstimationError,
    JobError,
    RequirementUnmet,
)
from bodycap_batch.pipeline import flow
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.requirement import unmet_requirement
from bodycap_batch.pipeline.results import (
    clear_partial,
    publish,
    remove_outdated,
    stored_name,
    write_results_file,
)
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.pipeline.stage_results import StageResults
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.report.summary import ResultSummary, summary_of_folder
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.store.checked_json import checked_json
from bodycap_batch.tasks.order import STAGE_ORDER
from bodycap_batch.tasks.rotations import confirmed_frames, contradicted_share
from bodycap_batch.tasks.stage import RESULTS_FOLDER, read_summary

JOB_FILE = "job.yaml"
REPORT_FILE = "report.html"
RUN_SCHEMA = 1
"""Version of the layout of ``run.json``. Another number means that a key was removed, or that it has another
meaning. Keys can be added at any time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """The outcome of a finished job.

    Attributes:
        out_dir: Folder of the results.
        files: Names of the result files, relative to `out_dir`; empty if the run ended before the last stage.
        stages: The record of every task that contributed to the results, computed in this run or reused.
        versions: Versions of Python, of this program and of the libraries that computed the results.
        verdict: The verdict about the results; None if the run ended before the last stage.
        unmet: The error about results that do not reach what the job requires; None if they do.
    """

    out_dir: Path
    files: tuple[str, ...]
    stages: tuple[StageRecord, ...]
    versions: Mapping[str, str]
    verdict: ResultSummary | None = None
    unmet: RequirementUnmet | None = None

    @property
    def executed(self) -> int:
        """Number of tasks that were computed in this run."""
        return sum(not stage.reused for stage in self.stages)


def run_job(job: Job, *, out_dir: Path, settings: Settings) -> RunSummary:
    """Run all stages of a job, and publish the results; stored results are not computed again.

    Args:
        job: A resolved job.
        out_dir: Folder of the results. Results of an earlier run stay in this folder until this run publishes
            new results. The new results may be published before their video is rendered.
        settings: Settings of the run: store, threads, listener, cancellation.

    Returns:
        The summary of the run.

    Raises:
        BodycapError: A stage failed. If the skeleton could not be solved, the map, the cameras' paths and the
            frames are in ``<out_dir>/partial``. If only the report or the video failed, all other results are
            in `out_dir`.
    """
    settings.store.sweep()
    settings.raise_if_cancelled()
    results, runs_to_end = StageResults(facts=JobFacts.of(job)), settings.until in ("", STAGE_ORDER[-1])
    with StageRunner.of(job, settings, out_dir) as runner:
        stopped_by = _run_until(runner, results, out_dir)
        summary = _summary(runner, results, out_dir)
        if runs_to_end and results.exported is not None:
            folder = _publish_results(runner, results, out_dir)
            if stopped_by is not None:
                _add_hint(stopped_by, f"see {folder} for the other results")
            if results.failure is None:
                runner.keep_only_these()
        elif stopped_by is not None:
            _publish_failure_report(runner, results, stopped_by, out_dir)
    if (error := _combined_error(results.failure, stopped_by)) is not None:
        raise error
    if not runs_to_end:
        return replace(summary, files=())
    verdict = summary_of_folder(out_dir)
    unmet = None if verdict is None else unmet_requirement(job.require, verdict, out_dir)
    return replace(summary, verdict=verdict, unmet=unmet)


def run_stages(runner: StageRunner, results: StageResults) -> Iterator[str]:
    """Run the stages one after another, put their artefacts into `results`, and yield each stage's name.

    The name is yielded after the stage has finished. If the caller stops iterating, no further stage runs.
    """
    flow.check(runner, results)
    yield "check"
    yield from _run_to_paths(runner, results)
    _try_without_lenses(runner, results)
    try:
        results.registrations, results.links = flow.measure_rotations(runner, results)
    except EstimationError:  # there is no map
        results.stage, results.map, results.clocks, results.registrations = "map", None, None, {}
        raise
    yield "registration"
    results.stage = "merge"
    if results.failure is None and has_body(results.facts.job):
        try:
            results.merged = flow.merge(runner, results)
        except EstimationError as error:
            results.failure = error
    yield "merge"
    if results.merged is not None:
        results.stage = "fill"
        results.filled = flow.fill(runner, results)
    yield "fill"
    results.preview = flow.start_preview(runner, results) if results.facts.job.export.preview else None
    results.exported = flow.export(runner, results)
    yield "export"
    results.reported = flow.report(runner, results)
    yield "report"
    if results.preview is not None:
        results.previewed = results.preview.result()
        yield "preview"


def _run_to_paths(runner: StageRunner, results: StageResults) -> Iterator[str]:
    """Run the stages up to the final paths of the cameras, as `run_stages` does."""
    results.stage = "keyframes"
    results.keyframes = flow.select_keyframes(runner, results)
    if results.sound is not None:
        # What the sound leaves open is said before the map. It was compared in much less time.
        wait([results.sound])
    yield "keyframes"
    results.stage = "map"
    results.map = flow.build_map(runner, results)
    if results.sound is not None:
        results.sound.result()
    runner.report_notes(results.map, "map")
    yield "map"
    results.stage = "registration"
    results.registrations = flow.register(runner, results)
    refined = flow.refine_map(runner, flow.extend_map(runner, results))
    results.map = refined.map
    results.registrations = flow.recover(runner, refined)
    try:
        results.facts = flow.find_places(runner, results)
    except EstimationError as error:  # only the body needs the places
        results.failure = error
    results.clocks = flow.decide_clocks(runner, results)
    runner.report_notes(results.clocks, "clocks")
    with_sensors = replace(results, registrations=flow.use_sensors(runner, results))
    results.map, results.registrations = flow.map_lost_parts(runner, with_sensors)
    results.links = flow.compare_with_tracks(runner, results, results.registrations)


def _try_without_lenses(runner: StageRunner, results: StageResults) -> None:
    """Compute the paths again without given lenses that may be wrong; `results` gets them if better."""
    given = flow.contradicted_lenses(runner, results)
    if not given:
        return
    facts = flow.identify_videos(runner.settings, results.facts.with_unknown_lenses(given))
    found, names = StageResults(facts=facts, sound=results.sound), ", ".join(given)
    try:
        for stage in _run_to_paths(runner, found):
            if stage == "keyframes" and not _show_lenses(found.keyframes, given):
                return
    except EstimationError as error:
        runner.note(f"{names}: without the given lens there is no better map: {error.message}", "map")
        return
    before, after = (
        {name: read_summary(each.path) for name, each in links.items()}
        for links in (results.links, found.links)
    )
    is_right = all(contradicted_share(after[name]) <= MAX_CONTRADICTED for name in given)
    if not is_right or confirmed_frames(after) <= confirmed_frames(before):
        runner.note(f"{names}: the video does not confirm more without the given lens, so it stays", "map")
        return
    runner.note(
        f"{names}: the video confirms the path with the lens that it shows, so this lens is used", "map"
    )
    results.take_paths(found)


def _show_lenses(keyframes: Mapping[str, Artefact], cameras: Iterable[str]) -> bool:
    """Return whether the tracks of the videos determine the lenses of these cameras."""
    return all(read_summary(keyframes[name].path)["lens"] for name in cameras)


def _run_until(runner: StageRunner, results: StageResults, out_dir: Path) -> BodycapError | None:
    """Run the stages up to the last stage that the user wants.

    If the report is finished before the video of the results, the results are first published without the
    video.

    Returns:
        The error that stopped the stages; None if no error occurred. The error is returned only if a report
        or finished results can still be published. Otherwise the error is raised.
    """
    try:
        for stage in run_stages(runner, results):
            if stage == runner.settings.until:
                break
            if stage == "report" and results.preview is not None and not results.preview.done():
                runner.settings.results_ready(_publish_results(runner, results, out_dir))
    except BodycapError as error:
        # Finished results are published even if their report could not be written.
        reportable = results.exported is not None or _is_about_data(error)
        if isinstance(error, Cancelled) or not reportable:
            raise
        return error
    return None


def _is_about_data(error: BodycapError) -> bool:
    """Return True if the job or its videos caused the error; False if the machine or the program did."""
    return isinstance(error, JobError | CaptureError | EstimationError)


def _combined_error(failure: EstimationError | None, stopped_by: BodycapError | None) -> BodycapError | None:
    """Return the error to raise at the end of a job. The message of a second error is added to the hint.

    If both errors are given, `stopped_by` is returned if the machine or the program caused it. Otherwise
    `failure` is returned.

    Args:
        failure: The reason why the skeleton is missing; None if it is not missing.
        stopped_by: The error that stopped the job; None if the job was not stopped.
    """
    if failure is None or stopped_by is None:
        return failure or stopped_by
    first, second = (failure, stopped_by) if _is_about_data(stopped_by) else (stopped_by, failure)
    _add_hint(first, f"besides: {second.message}")
    return first


def _publish_failure_report(
    runner: StageRunner, results: StageResults, error: BodycapError, out_dir: Path
) -> None:
    """Publish the report of a job that was stopped by an error before results were written."""
    try:
        results.reported = flow.report(runner, results, error)
        runner.settings.raise_if_cancelled()
        publish(dict(files_of(results.reported)), out_dir / PARTIAL)
    except BodycapError as another:
        error.add_note(f"the report about this job could not be written: {another.message}")
        return
    _add_hint(error, f"see the report of the finished stages in {out_dir / PARTIAL / REPORT_FILE}")


def _add_hint(error: BodycapError, text: str) -> None:
    """Append a text to an error's hint, if the hint does not contain the text already."""
    if text not in (error.hint or ""):
        error.hint = f"{error.hint}; {text}" if error.hint else text


def _summary(runner: StageRunner, results: StageResults, out_dir: Path) -> RunSummary:
    """Return the summary of the results and tasks so far."""
    return RunSummary(
        out_dir=out_dir,
        files=tuple(_result_files(results)),
        stages=tuple(runner.records),
        versions={
            "bodycap_batch": bodycap_batch.__version__,
            "python": platform.python_version(),
            **dict(sorted(runner.libraries.items())),
        },
    )


def _publish_results(runner: StageRunner, results: StageResults, out_dir: Path) -> Path:
    """Publish the results and return their folder: ``partial`` if the skeleton could not be solved."""
    settings, job = runner.settings, results.facts.job
    settings.raise_if_cancelled()
    if results.failure is None:
        _write_results(job, results, _summary(runner, results, out_dir), settings)
        clear_partial(out_dir)
        return out_dir
    partial = out_dir / PARTIAL
    _write_results(job, results, _summary(runner, results, partial), settings)
    _add_hint(results.failure, f"see {partial} for the map, the camera paths and the frames")
    return partial


def _write_results(job: Job, results: StageResults, summary: RunSummary, settings: Settings) -> None:
    """Write the result files and then the record of the run, so that all files named in the record exist."""
    out_dir = summary.out_dir
    publish(_result_files(results), out_dir)
    resolved = yaml.safe_dump(
        job.model_dump(mode="json", exclude_none=True), sort_keys=False, allow_unicode=True
    )
    write_results_file(out_dir, JOB_FILE, resolved)
    remove_outdated(out_dir, summary.files)
    verdict = summary_of_folder(out_dir)
    record = {
        "schema_version": RUN_SCHEMA,
        "versions": dict(summary.versions),
        "store": stored_name(settings.store.root, out_dir),
        COMMAND_LINE: values_to_record(job, settings.overrides, out_dir),
        "threads": settings.threads,
        "seconds": round(sum(stage.seconds for stage in summary.stages), 3),
        "peak_memory_mb": max((stage.peak_memory_mb for stage in summary.stages), default=0.0),
        "stages": [asdict(stage) for stage in summary.stages],
        "files": list(summary.files),
        "verdict": None if verdict is None else verdict.verdict,
        "videos": {
            camera.name: [_recorded_path(path, out_dir) for path in camera.video]
            for camera in job.capture.cameras
        },
    }
    write_results_file(out_dir, RUN_FILE, checked_json(record))


def _recorded_path(path: Path, out_dir: Path) -> str:
    """Return a path for the record of a run: relative if it is beside the results, because both can move."""
    beside = path.is_relative_to(out_dir.parent)
    return os.path.relpath(path, out_dir) if beside else str(path)


def files_of(artefact: Artefact) -> list[tuple[str, Path]]:
    """Return the name for the user and the path in the store of each result file of an artefact."""
    return [
        (Path(name).relative_to(RESULTS_FOLDER).as_posix(), artefact.path / name)
        for name in artefact.files
        if name.startswith(f"{RESULTS_FOLDER}/")
    ]


def _result_files(results: StageResults) -> dict[str, Path]:
    """Return the path in the store of every result file, by the name for the user."""
    parts = (results.exported, results.reported, results.previewed)
    return {name: path for part in parts if part is not None for name, path in files_of(part)}
