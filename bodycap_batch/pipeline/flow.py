"""The tasks of one job and how they hang together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import CameraConfig, Job
from bodycap_batch.errors import Cancelled, EstimationError
from bodycap_batch.pipeline.inputs import (
    all_cameras,
    body_arguments,
    body_digest,
    camera_digest,
    has_body,
    key_of,
    one_camera,
)
from bodycap_batch.progress import Event, Listener
from bodycap_batch.runner import Runner, Task
from bodycap_batch.runner.parent import CHILD
from bodycap_batch.store import Artefact, Store
from bodycap_batch.tasks import STAGES, reach_rows, read_summary

ByCamera = Mapping[str, Artefact]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How a job is run; nothing here changes a result.

    Attributes:
        store: Where artefacts are kept.
        threads: Cores the job may keep busy.
        listener: Told what happens.
        cancelled: Asked several times a second whether to stop.
        command: The children's command line.
    """

    store: Store
    threads: int
    listener: Listener
    cancelled: Callable[[], bool]
    command: Sequence[str] = CHILD

    def runner(self, logs: Path, also: Callable[[], bool] = lambda: False) -> Runner:
        """A runner that stops when the user asks for it, or when `also` says so."""
        return Runner(
            self.store,
            logs=logs,
            listener=self.listener,
            cancelled=lambda: self.cancelled() or also(),
            command=self.command,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRecord:
    """One stage of a run: what it cost when it was computed, and whether that was now."""

    stage: str
    camera: str
    round: int
    reused: bool
    seconds: float
    peak_memory_mb: float


class Flow:
    """One job's tasks; a context manager, which waits for its threads.

    Args:
        job: A resolved job.
        settings: Store, threads, listener, cancellation.
        logs: Folder of the children's logs.
    """

    def __init__(self, job: Job, settings: Settings, *, logs: Path) -> None:
        self.records: list[StageRecord] = []
        self.libraries: dict[str, str] = {}
        self._job = job
        self._settings = settings
        self._abort = threading.Event()
        self._runner = settings.runner(logs, self._abort.is_set)
        self._pool = ThreadPoolExecutor(max_workers=max(1, settings.threads))
        self._digests: dict[str, str] = {}

    def __enter__(self) -> Flow:
        self._digests = self._camera_digests()
        return self

    def __exit__(self, failed: object, *_: object) -> None:
        self._abort.set()
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._runner.close()

    def check(self) -> None:
        """Refuse what cannot work before hours are spent on it; tell what is worth knowing.

        Raises:
            BodycapError: The job, a video or a calibration cannot be used.
        """
        body = body_digest(self._job, self._settings.store.digests) if has_body(self._job) else None
        key = key_of("check", {}, {"cameras": self._digests, "body": body})
        task = Task(key=key, arguments={"job": self._job.model_dump(mode="json")})
        side_by_side = min(self._settings.threads, len(self._job.capture.cameras))
        artefact = self._one(task, [STAGES["keyframes"].modules] * (side_by_side - 1))
        for note in read_summary(artefact.path)["notes"]:
            self._settings.listener(Event(kind="note", stage="check", what=f"note: {note}"))

    def keyframes(self) -> ByCamera:
        """Keyframes of every camera."""
        options = self._job.keyframes.model_dump(mode="json")
        capture = self._job.capture
        return self._all(
            Task(
                key=key_of("keyframes", options, {"camera": self._digests[camera.name]}),
                arguments={"capture": one_camera(capture, camera)},
                camera=camera.name,
                threads=self._share,
            )
            for camera in capture.cameras
        )

    def map(self, keyframes: ByCamera) -> Artefact:
        """The map of all keyframes."""
        # The distances, not the body: a mount stated a little better makes no other map.
        reach = reach_rows(body_arguments(self._job)) if has_body(self._job) else []
        inputs = {"cameras": self._digests, "keyframes": _content(keyframes), "reach": reach}
        key = key_of("map", self._map_options(), inputs)
        arguments = {
            "capture": all_cameras(self._job.capture),
            "selections": [str(artefact.path) for artefact in keyframes.values()],
            "reach": reach,
        }
        later = [name for name in ("merge", "export") if name == "export" or has_body(self._job)]
        # The mapper keeps one core busy; on another the libraries of the last stages load.
        meanwhile = [[module for name in later for module in STAGES[name].modules]]
        task = Task(key=key, arguments=arguments, threads=self._settings.threads)
        artefact = self._one(task, meanwhile if self._settings.threads > 1 else [])
        for note in read_summary(artefact.path).get("notes", []):
            self._settings.listener(Event(kind="note", stage="map", what=f"note: {note}"))
        return artefact

    def registrations(
        self,
        scene: Artefact,
        keyframes: ByCamera,
        previous: ByCamera | None = None,
        map_round: int = 0,
    ) -> ByCamera:
        """Every frame of every camera against the map."""
        return self._all(
            self._registration(camera, scene, keyframes, previous, map_round)
            for camera in self._job.capture.cameras
        )

    def grow(
        self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Put new keyframes where frames were lost and register again, until nothing is gained."""
        for map_round in range(1, self._job.registration.rounds + 1):
            wanted = {name: read_summary(item.path)["wanted"] for name, item in registrations.items()}
            wanted = {name: frames for name, frames in wanted.items() if frames}
            if not wanted:
                break
            grown = self._extend(scene, wanted, map_round)
            again = self.registrations(grown, keyframes, registrations, map_round)
            if _localised(again) <= _localised(registrations):
                break
            scene, registrations = grown, again
        return scene, registrations

    def refine(
        self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Where a camera's shutter rolls: the map without its bending, and every pose solved again."""
        if not any(read_summary(item.path)["rolling"] for item in registrations.values()):
            return scene, registrations
        inputs = {
            "cameras": self._digests,
            "map": scene.digest,
            "registrations": _content(registrations),
        }
        arguments = {
            "capture": all_cameras(self._job.capture),
            "previous": str(scene.path),
            "registrations": [str(item.path) for item in registrations.values()],
        }
        key = key_of("refine", self._map_options(), inputs)
        refined = self._one(Task(key=key, arguments=arguments, threads=self._settings.threads))
        after = 1 + max(record.round for record in self.records)
        return refined, self.registrations(refined, keyframes, registrations, after)

    def merge(self, scene: Artefact, registrations: ByCamera) -> Artefact:
        """The skeleton's motion, in the world."""
        options = self._job.merge.model_dump(mode="json")
        inputs = {
            "map": scene.digest,
            "registrations": _content(registrations),
            "body": body_digest(self._job, self._settings.store.digests),
        }
        arguments = {
            "map": str(scene.path),
            "registrations": [str(artefact.path) for artefact in registrations.values()],
            **body_arguments(self._job),
        }
        key = key_of("merge", options, inputs)
        return self._one(Task(key=key, arguments=arguments, threads=self._settings.threads))

    def export(
        self,
        keyframes: ByCamera,
        scene: Artefact,
        registrations: ByCamera,
        merged: Artefact | None,
        failure: EstimationError | None,
    ) -> Artefact:
        """The files of the results."""
        options = self._job.export.model_dump(mode="json")
        reason = None if failure is None else failure.message
        inputs = {
            "map": scene.digest,
            "registrations": _content(registrations),
            "keyframes": _content(keyframes),
            "merge": None if merged is None else merged.digest,
            "failure": reason,
        }
        arguments = {
            "map": str(scene.path),
            "registrations": [str(artefact.path) for artefact in registrations.values()],
            "keyframes": [str(artefact.path) for artefact in keyframes.values()],
            "merge": None if merged is None else str(merged.path),
            "failure": reason,
        }
        key = key_of("export", options, inputs)
        return self._one(Task(key=key, arguments=arguments, threads=self._settings.threads))

    @property
    def _share(self) -> int:
        """Threads for each of the tasks that run side by side, one per camera."""
        return max(1, self._settings.threads // len(self._job.capture.cameras))

    def _map_options(self) -> dict[str, Any]:
        return self._job.map.model_dump(mode="json")

    def _registration(
        self,
        camera: CameraConfig,
        scene: Artefact,
        keyframes: ByCamera,
        previous: ByCamera | None,
        map_round: int,
    ) -> Task:
        name = camera.name
        before = None if previous is None else previous[name]
        inputs = {
            "camera": self._digests[name],
            "map": scene.digest,
            "keyframes": keyframes[name].digest,
            "previous": None if before is None else before.digest,
        }
        arguments = {
            "capture": one_camera(self._job.capture, camera),
            "map": str(scene.path),
            "selection": str(keyframes[name].path),
            "previous": None if before is None else str(before.path),
        }
        # How often the map may grow decides which rounds are run, not what one of them gives.
        options = self._job.registration.model_dump(mode="json", exclude={"rounds"})
        key = key_of("registration", options, inputs)
        return Task(key=key, arguments=arguments, camera=name, round=map_round, threads=self._share)

    def _extend(self, scene: Artefact, wanted: Mapping[str, list[int]], map_round: int) -> Artefact:
        inputs = {"cameras": self._digests, "map": scene.digest, "extra": wanted}
        arguments = {
            "capture": all_cameras(self._job.capture),
            "previous": str(scene.path),
            "extra": wanted,
        }
        key = key_of("extend", self._map_options(), inputs)
        return self._one(Task(key=key, arguments=arguments, round=map_round, threads=self._settings.threads))

    def _one(self, task: Task, meanwhile: Sequence[Sequence[str]] = ()) -> Artefact:
        task = replace(task, modules=STAGES[task.key.stage].modules)
        artefact, made = self._runner.run(task, meanwhile)
        self.libraries.update(task.key.libraries)
        self.records.append(
            StageRecord(
                stage=task.key.stage,
                camera=task.camera,
                round=task.round,
                reused=not made,
                seconds=float(artefact.made["seconds"]),
                peak_memory_mb=float(artefact.made["peak_memory_mb"]),
            )
        )
        return artefact

    def _all(self, tasks: Iterable[Task]) -> dict[str, Artefact]:
        """Run one task per camera side by side; the first failure stops the others."""
        ordered = list(tasks)
        futures = [self._pool.submit(self._one, task) for task in ordered]
        wait(futures, return_when=FIRST_EXCEPTION)
        failures = [error for future in futures if future.done() and (error := future.exception())]
        if failures:
            self._abort.set()
            raise next((error for error in failures if not isinstance(error, Cancelled)), failures[0])
        return {task.camera: future.result() for task, future in zip(ordered, futures, strict=True)}

    def _camera_digests(self) -> dict[str, str]:
        capture, digests = self._job.capture, self._settings.store.digests
        total = sum(
            path.stat().st_size for camera in capture.cameras for path in camera.video if path.exists()
        )
        read = 0

        def on_bytes(count: int) -> None:
            nonlocal read
            read += count
            if self._settings.cancelled():
                raise Cancelled("stopped on request", hint="run it again to go on")
            self._settings.listener(
                Event(kind="progress", stage="reading videos", done=read >> 20, total=total >> 20, what="MB")
            )

        return {camera.name: camera_digest(capture, camera, digests, on_bytes) for camera in capture.cameras}


def _content(artefacts: ByCamera) -> dict[str, str]:
    return {name: artefact.digest for name, artefact in artefacts.items()}


def _localised(registrations: ByCamera) -> int:
    return sum(int(read_summary(item.path)["localised"]) for item in registrations.values())
