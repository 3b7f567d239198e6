"""Write the files for one program from the stored results of a job."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from bodycap_batch.config.export_targets import ExportTarget, export_target
from bodycap_batch.config.models import Job
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.core.progress import Event
from bodycap_batch.export.camera_files import CAMERA_FACTS_FILE
from bodycap_batch.export.fill_report import FILL_FILE
from bodycap_batch.formats.blender import write_blend
from bodycap_batch.formats.blender.scene_script import SCENE_FILE, SCRIPT_FILE
from bodycap_batch.formats.fbx import require_blender
from bodycap_batch.formats.optional_libraries import require_formats
from bodycap_batch.pipeline import flow
from bodycap_batch.pipeline.inputs import has_body
from bodycap_batch.pipeline.reporting import find_stored
from bodycap_batch.pipeline.results import publish, write_results_file
from bodycap_batch.pipeline.run import files_of
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.stage_results import StageResults
from bodycap_batch.pipeline.stage_runner import StageRunner

GUIDE_FILE = "HOW_TO_IMPORT.txt"
BLEND_FILE = "scene.blend"
_NOT_FOR_PROGRAMS = ("metrics.json", FILL_FILE)


def export_for(
    job: Job, target: str, *, out_dir: Path, folder: Path, fps: float | None, settings: Settings
) -> list[Path]:
    """Write the files for one program. Only the export stage is computed.

    Args:
        job: A resolved job. Its options `fps` and `smoothing_hz` are kept, all others follow the program.
        target: Name of the program.
        out_dir: Folder of the job's results.
        folder: Folder for the files of the program.
        fps: Rate of the files, frames per second; None for the job's rate.
        settings: Settings of the run: store, threads, listener, cancellation.

    Returns:
        The paths of the files. ``HOW_TO_IMPORT.txt`` is the last one.

    Raises:
        BodycapError: There is no such program, the job has no body, Blender is missing, the disk fails, the
            store does not hold the results, or they do not give the program's main file. Then the folder is
            unchanged.
    """
    program = export_target(target)
    if not has_body(job):
        raise JobError(
            "the job has no body, so there is no motion to export",
            field="skeleton",
            hint="run the job with `skeleton: auto` or `skeleton: full_body`",
        )
    options = ExportOptions.model_validate(
        {"target": target, "fps": fps or job.export.fps, "smoothing_hz": job.export.smoothing_hz}
    )
    require_formats(options.formats)
    results, stopped_by = find_stored(job, out_dir, settings, last="fill")
    if results.filled is None:
        error = results.failure or stopped_by
        assert error is not None
        raise error
    _set_export(results, options)
    with StageRunner.of(job, settings, out_dir) as runner:
        exported = flow.export(runner, results)
    files = {name: path for name, path in files_of(exported) if name not in _NOT_FOR_PROGRAMS}
    if program.file not in files:
        raise EstimationError(
            f"the results contain no motion for {program.title}, so {program.file} was not written",
            path=out_dir,
            hint="look at the report: it says what is missing and why",
        )
    settings.raise_if_cancelled()
    publish(files, folder)
    if SCENE_FILE in files:
        _name_videos(folder, results.facts.job)
    written = [folder / name for name in files]
    if target == "blender":
        written += _blend_file(folder, settings)
    write_results_file(folder, GUIDE_FILE, _guide(job, program, options))
    return [*written, folder / GUIDE_FILE]


def export_undistorted(
    job: Job, *, out_dir: Path, folder: Path, fps: float | None, settings: Settings
) -> list[Path]:
    """Write the undistorted clip of each camera, and the animated cameras that match the clips.

    Only the export stage and the clips are computed.

    Args:
        job: A resolved job. Its export options decide the frames, as for the other files for animation.
        out_dir: Folder of the job's results.
        folder: Folder for the clips.
        fps: Frames per second; None for the job's rate.
        settings: Settings of the run: store, threads, listener, cancellation.

    Returns:
        The paths of the files: one clip and one .chan file for each camera, and ``cameras.json``.

    Raises:
        BodycapError: A video cannot be read, the disk fails, the store does not hold the results, or no
            camera was localised. Then the folder is unchanged.
    """
    results, stopped_by = find_stored(job, out_dir, settings, last="fill")
    if results.map is None or results.clocks is None:
        assert stopped_by is not None
        raise stopped_by
    options = job.export.model_copy(update={"formats": ("chan",), "fps": fps or job.export.fps})
    _set_export(results, options)
    with StageRunner.of(job, settings, out_dir) as runner:
        exported = flow.export(runner, results)
        files = {name: path for name, path in files_of(exported) if name not in _NOT_FOR_PROGRAMS}
        if CAMERA_FACTS_FILE not in files:
            raise EstimationError(
                "no camera was localised, so there is no clip to undistort",
                path=out_dir,
                hint="look at the report: it says what is missing and why",
            )
        facts = json.loads(files[CAMERA_FACTS_FILE].read_text(encoding="utf-8"))
        for clip in flow.undistort(runner, results, exported, facts["cameras"]).values():
            files |= dict(files_of(clip))
    settings.raise_if_cancelled()
    publish(files, folder)
    return [folder / name for name in files]


def _set_export(results: StageResults, options: ExportOptions) -> None:
    """Replace the export options of the job of these results."""
    job = results.facts.job.model_copy(update={"export": options})
    results.facts = replace(results.facts, job=job)


def _name_videos(folder: Path, job: Job) -> None:
    """Add the videos to the data of the Blender scene, because the folder may lie anywhere.

    The export stage does not know them: its results do not depend on where the videos are.
    """
    scene = json.loads((folder / SCENE_FILE).read_text(encoding="utf-8"))
    scene["videos"] = {camera.name: [str(path) for path in camera.video] for camera in job.capture.cameras}
    write_results_file(folder, SCENE_FILE, json.dumps(scene, indent=1, ensure_ascii=False) + "\n")


def _blend_file(folder: Path, settings: Settings) -> list[Path]:
    """Write the scene as a .blend file, if Blender can be used; otherwise a note says why not."""
    try:
        require_blender()
    except JobError as error:
        text = f"note: {BLEND_FILE} is not written ({error.message}); {SCRIPT_FILE} builds it in Blender"
        settings.listener(Event(kind="note", stage="export", what=text))
        return []
    return [write_blend(folder / BLEND_FILE)]


def _guide(job: Job, program: ExportTarget, options: ExportOptions) -> str:
    """Return the text of the file that says what to do in the program."""
    names: str = options.names
    if str(job.skeleton).lower().endswith(".bvh"):
        names += ", for the joints of the skeleton file that have a role; others keep their names"
    facts = [
        f"The motion of {job.name}, made for {program.title}. The file to import is {program.file}.",
        f"Joint names: {names}. Root: {options.root}. T-pose as frame 0: {'yes' if options.tpose else 'no'}.",
        "The bind pose is a T-pose. Unit: centimetre; GLB files: metre. Up: Y. Front: +Z.",
    ]
    steps = [f"{number}. {step}" for number, step in enumerate(program.steps, start=1)]
    return "\n".join([*facts, "", *steps]) + "\n"
