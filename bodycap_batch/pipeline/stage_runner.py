"""Run the tasks of one job, in parallel if possible. Each task is recorded; a failure stops all tasks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ALL_COMPLETED, FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import Cancelled
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.runner.child_pool import NOTHING_TO_LOAD, Preload
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.store.disk_space import require_room
from bodycap_batch.store.references import References, in_use
from bodycap_batch.tasks.stage import read_summary


class StageRunner:
    """Runs the tasks of one job; a context manager that waits for its threads at the end.

    Attributes:
        settings: Settings of the run: store, threads, listener, cancellation.
        records: The record of every task that has contributed to the results so far.
        libraries: Version of each library that these tasks used, by library name.

    Args:
        settings: Settings of the run: store, threads, listener, cancellation.
        logs: Folder for the logs of the child processes.
        cameras: Number of cameras of the job. At most this number of tasks runs at the same time.
    """

    def __init__(self, settings: Settings, *, logs: Path, cameras: int) -> None:
        self.records: list[StageRecord] = []
        self.libraries: dict[str, str] = {}
        self.settings = settings
        self._cameras = cameras
        self._folders = (settings.store.root, logs.parent)
        self._stop_all = threading.Event()
        self._runner = settings.runner(logs, self._stop_all.is_set, self._require_room)
        self._pool = ThreadPoolExecutor(max_workers=self.parallel_tasks)
        self._references = References(settings.store, logs.parent)
        self._frame_counts = (0, 0)
        self._noted: set[str] = set()
        self._opened = ExitStack()

    @staticmethod
    def of(job: Job, settings: Settings, out_dir: Path) -> StageRunner:
        """Return the runner of a job whose results are in the folder `out_dir`."""
        return StageRunner(settings, logs=out_dir / "logs", cameras=len(job.capture.cameras))

    def __enter__(self) -> StageRunner:
        with ExitStack() as opened:
            opened.enter_context(in_use(self.settings.store))
            opened.callback(self._runner.close)
            opened.callback(self._pool.shutdown, wait=True, cancel_futures=True)
            opened.callback(self._stop_all.set)
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    @property
    def parallel_tasks(self) -> int:
        """Maximum number of tasks of this job that are requested at the same time."""
        at_once = self._cameras if self.settings.executor is not None else self.settings.threads
        return max(1, min(at_once, self._cameras))

    def threads_per_camera(self) -> list[int]:
        """Return the number of threads for the task of each camera, in the order of the cameras.

        The tasks run in groups of `parallel_tasks`. The last group may be smaller; its tasks share all
        threads.
        """
        if self.settings.executor is not None:
            return [self.settings.threads] * self._cameras
        last = self._cameras % self.parallel_tasks or self.parallel_tasks
        first = [max(1, self.settings.threads // self.parallel_tasks)] * (self._cameras - last)
        return first + [max(1, self.settings.threads // last)] * last

    def expect_frames(self, frames: int, large_frames: int) -> None:
        """Set the numbers of frames of the job, from which the required disk space is estimated.

        Args:
            frames: Number of frames of all cameras.
            large_frames: Number of those frames whose size in the video is much larger than the work size
                (the image size that all stages work at).
        """
        self._frame_counts = (frames, large_frames)

    def run(self, task: Task, preload: Preload = NOTHING_TO_LOAD) -> Artefact:
        """Return a task's artefact: from the store, or computed now if it is not stored.

        Args:
            task: The task.
            preload: Modules that idle child processes load while this task is computed.

        Raises:
            BodycapError: The task failed. `NotStored`: the artefact is missing and nothing may be computed.
        """
        try:
            artefact, computed = self._runner.run(replace(task, priority=self.settings.priority), preload)
        except Cancelled:
            # The task may have stored its artefact before it was stopped.
            if (stored := self.settings.store.find(task.key)) is not None:
                self._references.add(stored.path)
            raise
        self._references.add(artefact.path)
        self.libraries.update(task.key.libraries)
        self.records.append(
            StageRecord(
                stage=task.key.stage,
                camera=task.camera,
                round=task.round,
                reused=not computed,
                seconds=float(artefact.made["seconds"]),
                cpu_seconds=artefact.made.get("cpu_seconds"),
                peak_memory_mb=float(artefact.made["peak_memory_mb"]),
                artefact=artefact.path.relative_to(self.settings.store.root).as_posix(),
                acted=artefact.made.get("acted", {}),
            )
        )
        return artefact

    def start(self, function: Callable[[], Artefact]) -> Future[Artefact]:
        """Call a function that runs a task in another thread, and return the future of its artefact."""
        return self._pool.submit(function)

    def start_beside(self, function: Callable[[], object]) -> None:
        """Call a function of this process in another thread. Its errors are ignored: it only saves time."""
        self._pool.submit(function)

    def run_all(self, tasks: Iterable[Task]) -> dict[str, Artefact]:
        """Run one task per camera at the same time, and return the artefacts by camera name.

        The first failure stops the other tasks. If nothing may be computed, all tasks are looked up, so that
        `NotStored` names every missing task.
        """
        ordered = list(tasks)
        futures = [self._pool.submit(self.run, task) for task in ordered]
        wait(futures, return_when=FIRST_EXCEPTION if self.settings.compute else ALL_COMPLETED)
        failures = [error for future in futures if future.done() and (error := future.exception())]
        if missing := [error for error in failures if isinstance(error, NotStored)]:
            raise NotStored([task for error in missing for task in error.tasks], self.settings.store.root)
        if failures:
            self._stop(futures)
            raise next((error for error in failures if not isinstance(error, Cancelled)), failures[0])
        return {task.camera: future.result() for task, future in zip(ordered, futures, strict=True)}

    def keep_only_these(self) -> None:
        """Keep only the references to artefacts that this run used; remove references of earlier runs."""
        self._references.keep_only(record.artefact for record in self.records)

    def report_notes(self, artefact: Artefact, stage: str) -> None:
        """Send the notes of an artefact to the listener; a note that was sent before is not repeated."""
        for note in read_summary(artefact.path).get("notes", []):
            self.note(note, stage)

    def note(self, text: str, stage: str = "") -> None:
        """Send a note to the listener; a note that was sent before is not repeated."""
        if text not in self._noted:
            self._noted.add(text)
            self.settings.listener(Event(kind="note", stage=stage, what=f"note: {text}"))

    def _require_room(self, task: Task) -> None:
        """Refuse to start a task if the disk space has become too small since the job's check."""
        if task.key.stage != "check":
            for folder in self._folders:
                for note in require_room(folder, *self._frame_counts):
                    self.note(note)

    def _stop(self, futures: Sequence[Future[Artefact]]) -> None:
        """Stop all running tasks after a failure. Tasks that start later, such as the report, may run."""
        self._stop_all.set()
        for future in futures:
            future.cancel()
        wait(futures)
        self._stop_all.clear()
