"""A sample capture that a job asks for, rendered on first use."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bodycap_batch.config.explain import job_error, problems_of
from bodycap_batch.core.errors import JobError
from bodycap_batch.pipeline.inputs import key_of
from bodycap_batch.pipeline.results import publish, write_results_file
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.runner import Task
from bodycap_batch.store.artefacts import ArtefactKey
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.store.references import References, in_use
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.tasks import CAPTURE

_STAMP = ".rendered.json"


def prepare_capture(options: Mapping[str, Any], folder: Path, settings: Settings) -> None:
    """Render a synthetic capture into a folder, unless the same one is complete there.

    Args:
        options: Options of the renderer, as in the job.
        folder: Where the videos belong; files of other names there stay.
        settings: Store, threads, listener, cancellation.

    Raises:
        BodycapError: The options are wrong, rendering failed, or the folder cannot be written.
    """
    key = _key(options, folder, settings.store.digests)
    if _is_complete(folder, key):
        return
    logs = folder / "logs"
    with in_use(settings.store), settings.runner(logs) as runner:
        artefact, _ = runner.run(Task(key=key, threads=settings.threads))
        References(settings.store, folder).add(artefact.path)
    files = {
        Path(name).relative_to(CAPTURE).as_posix(): artefact.path / name
        for name in artefact.files
        if name.startswith(f"{CAPTURE}/")
    }
    publish(files, folder)
    sizes = {name: path.stat().st_size for name, path in files.items()}
    write_results_file(folder, _STAMP, json.dumps({"key": key.name, "sizes": sizes}, indent=1))
    shutil.rmtree(logs, ignore_errors=True)


def _key(options: Mapping[str, Any], folder: Path, digests: FileDigests) -> ArtefactKey:
    try:
        checked = SynthOptions.model_validate(dict(options))
    except ValidationError as error:
        refused = job_error(problems_of(error, SynthOptions, dict(options)), folder)
        refused.path = None
        refused.field = ".".join(part for part in ("capture.synthetic", refused.field) if part)
        raise refused from error
    try:
        motion = digests.sha256(checked.motion) if checked.motion else None
    except OSError as error:
        field = "capture.synthetic.motion"
        hint = "the path of a BVH file, relative to the job"
        raise JobError(
            f"cannot be read: {error.strerror}", path=checked.motion, field=field, hint=hint
        ) from error
    return key_of("synth", checked.model_dump(mode="json"), {"motion": motion})


def _is_complete(folder: Path, key: ArtefactKey) -> bool:
    try:
        stamp = json.loads((folder / _STAMP).read_text(encoding="utf-8"))
        sizes = {str(name): (folder / name).stat().st_size for name in stamp["sizes"]}
        return bool(stamp["key"] == key.name and sizes == stamp["sizes"])
    except (OSError, ValueError, KeyError, TypeError):
        return False
