"""Render the synthetic capture of a job on first use."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bodycap_batch.config.explain import job_error, problems_of
from bodycap_batch.core.errors import JobError
from bodycap_batch.pipeline.results import publish, write_results_file
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.task_keys import make_task
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import ArtefactKey
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.store.references import References, in_use
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.tasks.inputs import FileRef
from bodycap_batch.tasks.stage import CAPTURE_FOLDER
from bodycap_batch.tasks.synth import SynthTask

_STAMP = ".rendered.json"


def prepare_capture(options: Mapping[str, Any], folder: Path, settings: Settings) -> None:
    """Render a synthetic capture into a folder, if the folder does not hold the complete capture already.

    Args:
        options: Options of the renderer, as the job gives them.
        folder: Folder for the videos; other files in the folder stay unchanged.
        settings: Settings of the run: store, threads, listener, cancellation.

    Raises:
        BodycapError: The options are wrong, rendering failed, or the folder cannot be written.
    """
    task = _synth_task(options, settings)
    if _is_complete(folder, task.key):
        return
    logs = folder / "logs"
    with in_use(settings.store), settings.runner(logs) as runner:
        artefact, _ = runner.run(task)
        References(settings.store, folder).add(artefact.path)
    files = {
        Path(name).relative_to(CAPTURE_FOLDER).as_posix(): artefact.path / name
        for name in artefact.files
        if name.startswith(f"{CAPTURE_FOLDER}/")
    }
    publish(files, folder)
    sizes = {name: path.stat().st_size for name, path in files.items()}
    write_results_file(folder, _STAMP, json.dumps({"key": task.key.name, "sizes": sizes}, indent=1))
    shutil.rmtree(logs, ignore_errors=True)


def _synth_task(options: Mapping[str, Any], settings: Settings) -> Task:
    try:
        checked = SynthOptions.model_validate(dict(options))
    except ValidationError as error:
        refused = job_error(problems_of(error, SynthOptions, dict(options)))
        refused.field = ".".join(part for part in ("capture.synthetic", refused.field) if part)
        raise refused from error
    task = SynthTask(
        options=checked,
        motion=_motion_ref(checked.motion, settings.store.digests),
        motion_name=None if checked.motion is None else checked.motion.name,
    )
    return make_task(task, threads=settings.threads)


def _motion_ref(path: Path | None, digests: FileDigests) -> FileRef | None:
    try:
        return None if path is None else FileRef(path=path, digest=digests.sha256(path))
    except OSError as error:
        field = "capture.synthetic.motion"
        hint = "give the path of a BVH file, relative to the job file"
        raise JobError(
            f"the motion file cannot be read: {error.strerror}", path=path, field=field, hint=hint
        ) from error


def _is_complete(folder: Path, key: ArtefactKey) -> bool:
    try:
        stamp = json.loads((folder / _STAMP).read_text(encoding="utf-8"))
        sizes = {str(name): (folder / name).stat().st_size for name in stamp["sizes"]}
        return bool(stamp["key"] == key.name and sizes == stamp["sizes"])
    except (OSError, ValueError, KeyError, TypeError):
        return False
