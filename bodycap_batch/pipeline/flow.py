"""The tasks of one job and how they hang together."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ALL_COMPLETED, FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import CameraConfig, Job
from bodycap_batch.core.errors import BodycapError, Cancelled, CaptureError, EstimationError, JobError
from bodycap_batch.core.progress import Event
from bodycap_batch.formats.optional_libraries import require_libraries
from bodycap_batch.pipeline.inputs import (
    all_cameras,
    body_arguments,
    body_digest,
    camera_digests,
    content_of,
    has_body,
    kept_in,
    key_of,
    localised_in,
    merge_arguments,
    one_camera,
)
from bodycap_batch.pipeline.made import Made, preview_task, report_task
from bodycap_batch.pipeline.recovery import recovery_tasks
from bodycap_batch.pipeline.rigs import rig_tasks, segments_of
from bodycap_batch.pipeline.settings import Settings, StageRecord
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.store.disk_space import require_room
from bodycap_batch.store.references import References, in_use
from bodycap_batch.tasks import STAGES, reach_rows, read_summary

ByCamera = Mapping[str, Artefact]


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
        self._folders = (settings.store.root, logs.parent)
        self._runner = settings.runner(logs, self._abort.is_set, self._require_room)
        self._pool = ThreadPoolExecutor(max_workers=self._side_by_side)
        self._digests: dict[str, str] = {}
        self._open = ExitStack()
        self._references = References(settings.store, logs.parent)
        self._frames = (0, 0)
        self._told: set[str] = set()

    def __enter__(self) -> Flow:
        with ExitStack() as opened:
            opened.enter_context(in_use(self._settings.store))
            opened.callback(self._runner.close)
            opened.callback(self._pool.shutdown, wait=True, cancel_futures=True)
            opened.callback(self._abort.set)
            self._open = opened.pop_all()
        return self

    def __exit__(self, failed: object, *_: object) -> None:
        self._open.close()

    def check(self) -> None:
        """Refuse what cannot work before hours are spent on it; tell what is worth knowing.

        Raises:
            BodycapError: The job, a video or a calibration cannot be used.
        """
        try:
            task = self._check_task()
        except (CaptureError, JobError):
            self._settings.listener(Event(kind="failed", stage="check"))
            raise
        artefact = self._one(task, [STAGES["keyframes"].modules] * (self._side_by_side - 1))
        found = read_summary(artefact.path)
        self._frames = (int(found["frames"]), int(found.get("large_frames", 0)))
        self._tell_notes(artefact, "check")

    def _check_task(self) -> Task:
        digests = self._settings.store.digests
        self._digests = camera_digests(
            self._job.capture, digests, self._settings.listener, self._settings.cancelled
        )
        body = None
        if has_body(self._job):
            # What is installed can change between two runs: looked at each time, not kept with the check.
            require_libraries(self._job.export.formats)
            body = body_digest(self._job, self._settings.store.digests)
        bounds = {} if self._settings.limits is None else {"limits": asdict(self._settings.limits)}
        files = self._job.export.model_dump(mode="json", include={"formats", "names"})
        key = key_of("check", {}, {"cameras": self._digests, "body": body, "files": files, **bounds})
        arguments = {"job": self._job.model_dump(mode="json"), **bounds}
        return Task(key=key, arguments=arguments, threads=self._settings.threads)

    def keyframes(self) -> ByCamera:
        """Keyframes of every camera."""
        options = self._job.keyframes.model_dump(mode="json")
        capture = self._job.capture
        return self._all(
            Task(
                key=key_of("keyframes", options, {"camera": self._digests[camera.name]}),
                arguments={"capture": one_camera(capture, camera)},
                camera=camera.name,
                threads=threads,
            )
            for camera, threads in zip(capture.cameras, self._shares(), strict=True)
        )

    def map(self, keyframes: ByCamera) -> Artefact:
        """The map of all keyframes."""
        # The distances, not the body: a mount stated a little better makes no other map.
        reach = reach_rows(body_arguments(self._job)) if has_body(self._job) else []
        inputs = {"cameras": self._digests, "keyframes": content_of(keyframes), "reach": reach}
        key = key_of("map", self._map_options(), inputs)
        arguments = {
            "capture": all_cameras(self._job.capture),
            "selections": [str(artefact.path) for artefact in keyframes.values()],
            "kept": kept_in(keyframes),
            "reach": reach,
        }
        later = [*(["merge"] if has_body(self._job) else []), "export", "report"]
        # The mapper keeps one core busy; on another the libraries of the last stages load.
        meanwhile = [[module for name in later for module in STAGES[name].modules]]
        task = Task(key=key, arguments=arguments, threads=self._settings.threads)
        artefact = self._one(task, meanwhile if self._settings.threads > 1 else [])
        self._tell_notes(artefact, "map")
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
            replace(self._registration(camera, scene, keyframes, previous, map_round), threads=threads)
            for camera, threads in zip(self._job.capture.cameras, self._shares(), strict=True)
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
            grown = self._extend(scene, wanted, keyframes, map_round)
            again = self.registrations(grown, keyframes, registrations, map_round)
            gained = localised_in(again) - localised_in(registrations)
            if gained < 0:
                break
            # Keyframes that the video contradicted were placed anew, even where no frame was gained.
            scene, registrations = grown, again
            if gained == 0:
                break
        return scene, registrations

    def refine(
        self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Where a camera's shutter rolls: the map without its bending, and every pose solved again."""
        if not any(read_summary(item.path)["rolling"] for item in registrations.values()):
            return scene, registrations
        known = content_of(registrations)
        inputs = {"cameras": self._digests, "map": scene.digest, "registrations": known}
        arguments = {
            "capture": all_cameras(self._job.capture),
            "previous": str(scene.path),
            "registrations": [str(item.path) for item in registrations.values()],
        }
        key = key_of("refine", self._map_options(), inputs)
        refined = self._one(Task(key=key, arguments=arguments, threads=self._settings.threads))
        after = 1 + max(record.round for record in self.records)
        return refined, self.registrations(refined, keyframes, registrations, after)

    def solve_rigs(self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera) -> ByCamera:
        """Cameras that one trigger exposes: their frames again, from what all of them see."""
        found = self._all(rig_tasks(self._job, self._digests, scene, keyframes, registrations))
        for artefact in found.values():
            self._tell_notes(artefact, "registration")
        return {**registrations, **found}

    def recover(self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera) -> ByCamera:
        """Cameras that lost frames: these once more, by what the map's points look like."""
        tasks = recovery_tasks(self._job, self._digests, scene, keyframes, registrations)
        return {**registrations, **self._all(tasks)}

    def merge(self, scene: Artefact, registrations: ByCamera, keyframes: ByCamera) -> Artefact:
        """The skeleton's motion, in the world; a board is looked for in the pictures that keyframes keep."""
        options = self._job.merge.model_dump(mode="json")
        inputs = {
            "map": scene.digest,
            "registrations": content_of(registrations),
            "body": body_digest(self._job, self._settings.store.digests),
        }
        arguments = {
            "map": str(scene.path),
            "registrations": [str(artefact.path) for artefact in registrations.values()],
            **merge_arguments(self._job, keyframes),
        }
        task = Task(key=key_of("merge", options, inputs), arguments=arguments, threads=self._settings.threads)
        filming = self._job.export.preview and self._settings.threads > 1
        artefact = self._one(task, [STAGES["preview"].modules] if filming else [])
        self._tell_notes(artefact, "merge")
        return artefact

    def export(
        self,
        keyframes: ByCamera,
        scene: Artefact,
        registrations: ByCamera,
        merged: Artefact | None,
        failure: EstimationError | None,
    ) -> Artefact:
        """The files of the results."""
        options = self._job.export.model_dump(mode="json", exclude={"preview"})
        reason = None if failure is None else failure.message
        inputs = {
            "map": scene.digest,
            "registrations": content_of(registrations),
            "keyframes": content_of(keyframes),
            "merge": None if merged is None else merged.digest,
            "failure": reason,
            "segments": segments_of(self._job.capture),
        }
        arguments = {
            "map": str(scene.path),
            "registrations": [str(artefact.path) for artefact in registrations.values()],
            "segments": segments_of(self._job.capture),
            "keyframes": [str(artefact.path) for artefact in keyframes.values()],
            "merge": None if merged is None else str(merged.path),
            "failure": reason,
        }
        key = key_of("export", options, inputs)
        return self._one(Task(key=key, arguments=arguments, threads=self._settings.threads))

    def start_preview(self, made: Made) -> Future[Artefact] | None:
        """Begin the video of the results, beside what follows the merge; None where it is not wanted."""
        if self._settings.until not in ("", "preview") or made.scene is None:
            return None
        task = preview_task(self._job, made, self._digests)
        return self._pool.submit(self._one, replace(task, threads=self._settings.threads))

    def report(self, made: Made, stopped_by: BodycapError | None = None) -> Artefact:
        """The page a person reads, of all that was made."""
        error = stopped_by or made.failure
        failure = None if error is None else made.failed_at(error)
        return self._one(report_task(self._job, made, self._digests, failure))

    def keep_only_this(self) -> None:
        """Let go of the artefacts that earlier runs with other options referred to."""
        self._references.keep_only(record.artefact for record in self.records)

    def _shares(self) -> list[int]:
        """Threads of each of the tasks that run side by side, one per camera; the last ones share all."""
        cameras = len(self._job.capture.cameras)
        if self._settings.executor is not None:
            return [self._settings.threads] * cameras
        last = cameras % self._side_by_side or self._side_by_side
        first = [max(1, self._settings.threads // self._side_by_side)] * (cameras - last)
        return first + [max(1, self._settings.threads // last)] * last

    @property
    def _side_by_side(self) -> int:
        """How many tasks of this job are asked for at once."""
        cameras = len(self._job.capture.cameras)
        at_once = cameras if self._settings.executor is not None else self._settings.threads
        return max(1, min(at_once, cameras))

    def _require_room(self, task: Task) -> None:
        """Refuse to begin what will not fit on the disk; the space may have gone since the check was made."""
        if task.key.stage != "check":
            for folder in self._folders:
                for note in require_room(folder, *self._frames):
                    self._note(note)

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
            "kept": kept_in({name: keyframes[name]}),
            "previous": None if before is None else str(before.path),
        }
        # How often the map may grow decides which rounds are run, not what one of them gives.
        options = self._job.registration.model_dump(mode="json", exclude={"rounds"})
        key = key_of("registration", options, inputs)
        return Task(key=key, arguments=arguments, camera=name, round=map_round)

    def _extend(
        self, scene: Artefact, wanted: Mapping[str, list[int]], keyframes: ByCamera, map_round: int
    ) -> Artefact:
        known = content_of(keyframes)
        inputs = {"cameras": self._digests, "map": scene.digest, "keyframes": known, "extra": wanted}
        arguments = {
            "capture": all_cameras(self._job.capture),
            "kept": kept_in(keyframes),
            "previous": str(scene.path),
            "extra": wanted,
        }
        key = key_of("extend", self._map_options(), inputs)
        return self._one(Task(key=key, arguments=arguments, round=map_round, threads=self._settings.threads))

    def _one(self, task: Task, meanwhile: Sequence[Sequence[str]] = ()) -> Artefact:
        stage, priority = STAGES[task.key.stage], self._settings.priority
        task = replace(task, modules=stage.modules, memory_mb=stage.memory_mb, priority=priority)
        artefact, made = self._runner.run(task, meanwhile)
        self._references.add(artefact.path)
        self.libraries.update(task.key.libraries)
        self.records.append(
            StageRecord(
                stage=task.key.stage,
                camera=task.camera,
                round=task.round,
                reused=not made,
                seconds=float(artefact.made["seconds"]),
                cpu_seconds=artefact.made.get("cpu_seconds"),
                peak_memory_mb=float(artefact.made["peak_memory_mb"]),
                artefact=artefact.path.relative_to(self._settings.store.root).as_posix(),
            )
        )
        return artefact

    def _tell_notes(self, artefact: Artefact, stage: str) -> None:
        for note in read_summary(artefact.path).get("notes", []):
            self._note(note, stage)

    def _note(self, text: str, stage: str = "") -> None:
        """Tell something worth knowing, once."""
        if text not in self._told:
            self._told.add(text)
            self._settings.listener(Event(kind="note", stage=stage, what=f"note: {text}"))

    def _all(self, tasks: Iterable[Task]) -> dict[str, Artefact]:
        """Run one task per camera side by side; the first failure stops the others."""
        ordered = list(tasks)
        futures = [self._pool.submit(self._one, task) for task in ordered]
        wait(futures, return_when=FIRST_EXCEPTION if self._settings.compute else ALL_COMPLETED)
        failures = [error for future in futures if future.done() and (error := future.exception())]
        if missing := [error for error in failures if isinstance(error, NotStored)]:
            raise NotStored([task for error in missing for task in error.tasks], self._settings.store.root)
        if failures:
            self._end(futures)
            raise next((error for error in failures if not isinstance(error, Cancelled)), failures[0])
        return {task.camera: future.result() for task, future in zip(ordered, futures, strict=True)}

    def _end(self, futures: Sequence[Future[Artefact]]) -> None:
        """Stop the tasks beside one that failed; what is done next (a report of it) may run."""
        self._abort.set()
        for future in futures:
            future.cancel()
        wait(futures)
        self._abort.clear()
