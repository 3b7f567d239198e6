"""Find the job, the results and the store that a path on the command line means.

A command accepts a job file, a folder of videos and a folder of results alike. The working folder does not
matter: the results lie beside the job, and a folder of results names its store.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.config.folder import PARTIAL, RUN_FILE, is_video

if TYPE_CHECKING:
    from bodycap_batch.capture import Capture
    from bodycap_batch.config.models import Job
    from bodycap_batch.config.overrides import Overrides

_JOB_FILE, _STATUS_FILE = "job.yaml", "status.json"
_RESULT = "result"
"""Name of the subfolder with the results of a watched job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPlace:
    """What a path on the command line means.

    Attributes:
        file: The job to load: a job file or a folder of videos.
        results: The folder of results that the path means; None if the path is a job or a folder of videos.
    """

    file: Path
    results: Path | None = None


def find_job(path: Path) -> JobPlace:
    """Return the job and the results that a path means.

    A folder of results holds ``run.json`` and ``job.yaml``, itself or in its subfolder ``partial``. The
    folder of a job in a watched folder (``done/NAME``) means its results. A path that cannot be read is taken
    for a job; loading it reports why it cannot be read.
    """
    try:
        return _place_of(path)
    except OSError:
        return JobPlace(file=path)


def _place_of(path: Path) -> JobPlace:
    if (path / _STATUS_FILE).is_file() and (path / _RESULT).is_dir():
        path = path / _RESULT
    if _is_run(path):
        results = path.parent if path.name == PARTIAL else path
        return JobPlace(file=path / _JOB_FILE, results=results.resolve())
    if _is_run(path / PARTIAL) and not any(map(is_video, path.iterdir())):
        return JobPlace(file=path / PARTIAL / _JOB_FILE, results=path.resolve())
    return JobPlace(file=path)


def _is_run(folder: Path) -> bool:
    return (folder / RUN_FILE).is_file() and (folder / _JOB_FILE).is_file()


def load_last_run(path: Path, overrides: Overrides) -> Job:
    """Load the job whose results a command shows; its `out` is the folder of the results.

    If the job has run before, the job is loaded as it was run, with the height and the skeleton of that run.

    Args:
        path: A job file, a folder of videos or a folder of results.
        overrides: Values of the command line. If they change the job, the job itself is loaded.

    Raises:
        BodycapError: The job cannot be loaded.
    """
    from dataclasses import replace

    from bodycap_batch.config.job import load_job

    place = find_job(path)
    changes = overrides.skeleton is not None or overrides.height_m is not None
    if place.results is None and not changes:
        job = load_job(path, overrides)
        assert job.out is not None  # every loaded job has a folder for its results
        last = find_job(job.out)
        if last.results is None:
            return job
        place = last
    return load_job(place.file, replace(overrides, out=overrides.out or place.results))


def find_store(out_dir: Path) -> Path:
    """Return the store of a folder of results.

    It is the store that the results name in their ``run.json``. Without results, or if that store no longer
    exists, it is the folder ``.store`` beside the folder of results. Results of earlier program versions can
    have their store inside, which is then used further.
    """
    from bodycap_batch.pipeline.results import store_of_last_run

    named = store_of_last_run(out_dir) or store_of_last_run(out_dir / PARTIAL)
    inside = out_dir / ".store"
    known = [store for store in (named, inside) if store is not None and is_store(store)]
    return known[0] if known else out_dir.parent / ".store"


def is_store(folder: Path) -> bool:
    """Return True if a folder is a store with artefacts."""
    return (folder / "artefacts").is_dir()


def capture_of_results(job: Job, out_dir: Path) -> Capture:
    """Open the videos of a job with the frames, and their times, that its results list in ``frames.csv``."""
    from dataclasses import replace

    import numpy as np

    from bodycap_batch.capture import open_capture
    from bodycap_batch.formats.frame_table import read_frame_table
    from bodycap_batch.model.copied_frames import Pictures

    capture, file = open_capture(job.capture), out_dir / "frames.csv"
    tables = read_frame_table(file) if file.is_file() else {}
    cameras = []
    for camera in capture.cameras:
        numbers = camera.frame_numbers
        listed = tables[camera.name].frame_numbers if camera.name in tables else numbers[:0]
        _, frames, rows = np.intersect1d(numbers, listed, return_indices=True)
        if 1 < len(frames) < len(numbers):
            pictures = Pictures(frames=frames, times_ns=tables[camera.name].times_ns[rows])
            cameras.append(camera.only(pictures))
        else:
            cameras.append(camera)
    return replace(capture, cameras=tuple(cameras))
