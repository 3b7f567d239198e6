"""The stages of one job: each method creates the tasks of a stage, runs them and returns artefacts."""

from __future__ import annotations

import copy
import importlib
from collections.abc import Container, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.lost_frames import LEAST_LOST, LEAST_MAPPED, LEAST_POSED
from bodycap_batch.config.models import CameraConfig, CaptureConfig, Job
from bodycap_batch.config.mounts import MOTION_PLACES, TRUNK_ROLES, mount_of
from bodycap_batch.config.path_bounds import MAX_CONTRADICTED
from bodycap_batch.core.errors import BodycapError, CaptureError, EstimationError, JobError
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.core.progress import RECONSTRUCTION, Event
from bodycap_batch.formats.optional_libraries import require_libraries
from bodycap_batch.pipeline.inputs import (
    artefact_ref,
    body_input,
    camera_digests,
    capture_ref,
    has_body,
    optional_ref,
    refs_by_camera,
    samples_input,
)
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.stage_results import StageResults, preview_task, report_task
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.pipeline.task_keys import make_task
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.runner.child_pool import NOTHING_TO_LOAD, Preload
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks.body import camera_distances
from bodycap_batch.tasks.check import CheckTask
from bodycap_batch.tasks.clocks import CameraDistance, ClocksTask
from bodycap_batch.tasks.export import ExportTask
from bodycap_batch.tasks.fill import FillTask
from bodycap_batch.tasks.further import FurtherMapsTask, FurtherPosesTask
from bodycap_batch.tasks.inertial import InertialTask
from bodycap_batch.tasks.inputs import BodyInput, CaptureRef, FileRef, stated_clocks
from bodycap_batch.tasks.keyframes import KeyframesTask
from bodycap_batch.tasks.links import LinksTask
from bodycap_batch.tasks.mapping import ExtendTask, MapTask, RefineTask
from bodycap_batch.tasks.merge import BoardFootage, MergeTask
from bodycap_batch.tasks.places import PlacesTask
from bodycap_batch.tasks.recover import RecoverTask
from bodycap_batch.tasks.registration import RegistrationTask
from bodycap_batch.tasks.rotations import RotationsTask, contradicted_share, without_positions
from bodycap_batch.tasks.sound import SoundTask, known_from_sound
from bodycap_batch.tasks.stage import read_summary
from bodycap_batch.tasks.stages import STAGES
from bodycap_batch.tasks.undistort import UndistortTask

_MAX_RECOVERY_THREADS = 2
"""Maximum number of threads of the recovery of one camera. The cameras lose different numbers of frames, so
one task often runs alone at the end. Much of its work holds the interpreter's lock. Evidence:
docs/decisions/pipeline.md."""
ByCamera = Mapping[str, Artefact]


class Flow:
    """Runs the stages of one job; a context manager that waits for its threads at the end.

    Attributes:
        freed: By name of each camera whose given lens is not used, its given focal length over the width.

    Args:
        job: A resolved job.
        settings: Settings of the run: store, threads, listener, cancellation.
        logs: Folder for the logs of the child processes.
    """

    def __init__(self, job: Job, settings: Settings, *, logs: Path) -> None:
        self.runner = StageRunner(settings, logs=logs, cameras=len(job.capture.cameras))
        self._job = job
        self._capture = job.capture
        self._sound: Future[Artefact] | None = None
        self._settings = settings
        self._threads = settings.threads
        self._cameras: dict[str, str] = {}
        self._map_round = 0
        self._map_failure: EstimationError | None = None
        self.freed: Mapping[str, float] = {}
        self._with_telemetry = frozenset[str]()
        self._with_gyro = frozenset[str]()
        self._stabilised = frozenset[str]()
        self._samples: Mapping[str, FileRef] = {}

    def __enter__(self) -> Flow:
        self.runner.__enter__()
        return self

    def __exit__(self, *failure: object) -> None:
        self.runner.__exit__(*failure)

    def check(self) -> None:
        """Check the job before any long computation, and report notes to the user.

        Raises:
            BodycapError: The job, a video or a calibration cannot be used.
        """
        try:
            task = self._check_task()
        except (CaptureError, JobError):
            self._settings.listener(Event(kind="failed", stage="check"))
            raise
        preload = Preload(modules=[STAGES["keyframes"].modules] * (self.runner.parallel_tasks - 1))
        artefact = self.runner.run(task, preload)
        summary = read_summary(artefact.path)
        self.runner.expect_frames(int(summary["frames"]), int(summary.get("large_frames", 0)))
        found = {
            camera.name: samples_input(camera, self._settings.store.digests)
            for camera in self._capture.cameras
        }
        self._samples = {name: samples for name, samples in found.items() if samples is not None}
        self._with_telemetry = frozenset(summary.get("telemetry", ())) | self._samples.keys()
        self._stabilised = frozenset(summary.get("stabilised", ()))
        if self._job.telemetry.tracking:
            self._with_gyro = self._with_telemetry
        self.runner.report_notes(artefact, "check")
        if len(self._capture.cameras) > 1:
            self._sound = self._start_sound()
        if self._capture.start_s is not None or self._capture.end_s is not None:
            self._apply_sound_offsets()

    def keyframes(self) -> ByCamera:
        """Select the keyframes of every camera, and return the artefact of each camera.

        Damaged and frozen frames are reported to the user.
        """
        capture = self._capture
        selected = self.runner.run_all(
            make_task(
                KeyframesTask(
                    options=self._job.keyframes,
                    capture=capture_ref(capture, self._cameras, [camera]),
                    with_gyro=camera.name in self._with_gyro,
                    samples=self._samples.get(camera.name) if camera.name in self._with_gyro else None,
                ),
                camera=camera.name,
                threads=threads,
            )
            for camera, threads in zip(capture.cameras, self.runner.threads_per_camera(), strict=True)
        )
        for artefact in selected.values():
            self.runner.report_notes(artefact, "keyframes")
        if self._sound is not None:
            # What the sound leaves open is said before the map. It was compared in much less time.
            wait([self._sound])
        return selected

    def map(self, keyframes: ByCamera) -> Artefact:
        """Build the map of all keyframes and return its artefact.

        Without a body, the map may be empty: `measure_rotations` then has the last word.

        Raises:
            EstimationError: There is no map.
        """
        task = MapTask(
            options=self._job.map,
            capture=self._footage(),
            keyframes=refs_by_camera(keyframes),
            may_be_empty=self._may_be_rotations,
        )
        body = ["merge", "fill"] if has_body(self._job) else []
        later = ["registration", "clocks", "links", *body, "export", "report"]
        # Features and matches keep all cores busy. After them, mapping keeps one core busy. Only then does
        # another core load the libraries of later stages. Evidence: docs/decisions/pipeline.md.
        modules = [module for name in later for module in STAGES[name].modules]
        preload = self._preload([modules], ["registration", "clocks", *body[:1]], step=RECONSTRUCTION)
        artefact = self.runner.run(make_task(task, threads=self._threads), preload)
        if (failure := read_summary(artefact.path)["failure"]) is not None:
            self._map_failure = EstimationError(failure["message"], hint=failure["hint"])
            if self._settings.until == "map":
                raise self._map_failure
        if self._sound is not None:
            self._sound.result()  # The sound is compared in much less time, so this does not wait.
        self.runner.report_notes(artefact, "map")
        return artefact

    def _preload(
        self, modules: Sequence[Sequence[str]], next_stages: Sequence[str], step: str = ""
    ) -> Preload:
        """Return what an idle core does while a task runs: nothing if there is only one thread.

        Args:
            modules: Modules that idle children load: one list of module names for each child.
            next_stages: Names of the stages whose code this process reads.
            step: Name of the step of the task at which this begins; "" to begin with the task.
        """
        if self._threads == 1:
            return NOTHING_TO_LOAD
        read_ahead = partial(self.runner.start_beside, partial(_read_ahead, next_stages))
        return Preload(modules=modules, step=step, then=read_ahead)

    def register(
        self, scene_map: Artefact, keyframes: ByCamera, previous: ByCamera | None = None
    ) -> ByCamera:
        """Register every frame of every camera against the map.

        Args:
            scene_map: The artefact of the map.
            keyframes: The artefact with the keyframes of each camera, by camera name.
            previous: The artefact of each camera's registration against an earlier round of the map, by
                camera name. The tracks of these registrations are reused. None in the first round.
        """
        cameras = self._capture.cameras
        return self.runner.run_all(
            make_task(
                RegistrationTask(
                    options=self._job.registration,
                    capture=self._footage([camera]),
                    keyframes=refs_by_camera({camera.name: keyframes[camera.name]}),
                    map=artefact_ref(scene_map),
                    previous=optional_ref(None if previous is None else previous[camera.name]),
                ),
                camera=camera.name,
                map_round=self._map_round,
                threads=threads,
            )
            for camera, threads in zip(cameras, self.runner.threads_per_camera(), strict=True)
        )

    def extend_map(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Add keyframes at times of lost frames and register again, until no further frame is localised.

        Returns:
            The artefact of the extended map, and the registrations against this map. A round that fails, or
            that loses frames, is not used. Frames whose pose a round withdraws, because they contradict the
            map, were wrong before and do not count as lost.
        """
        rounds = self._job.registration.rounds if is_on(Mechanism.EXTENSION) else 0
        for _ in range(rounds):
            summaries = {name: read_summary(artefact.path) for name, artefact in registrations.items()}
            wanted = {name: summary["wanted"] for name, summary in summaries.items() if summary["wanted"]}
            if not wanted:
                break
            try:
                extended = self._extend(scene_map, wanted, keyframes)
            except EstimationError as error:
                cause = "the map could not be extended to localise lost frames"
                self.runner.note(f"{cause}, so the earlier map is kept: {error.message}", "extend")
                break
            again = self.register(extended, keyframes, registrations)
            gained = _posed_frames(again) - _posed_frames(registrations)
            if gained < 0:
                break
            # The new map is used even if no further frame is localised: misregistered keyframes have new
            # poses in the new map.
            scene_map, registrations = extended, again
            if gained == 0:
                break
        return scene_map, registrations

    def refine_map(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Remove the deformation of the map that rolling shutters cause, and solve all poses again.

        If no camera has a rolling shutter, the map and the registrations are returned unchanged. If readout
        times are unknown, and the keyframes show no rolling shutter, the registrations are unchanged.
        """
        before = read_summary(scene_map.path)
        if not before["rolling"] or not is_on(Mechanism.REFINEMENT):
            return scene_map, registrations
        task = RefineTask(
            options=self._job.map,
            capture=self._footage(),
            map=artefact_ref(scene_map),
            registrations=refs_by_camera(registrations),
        )
        refined = self.runner.run(make_task(task, threads=self._threads))
        if not read_summary(refined.path)["corrected"] and not before["corrected"]:
            return refined, registrations
        self._map_round += 1
        return refined, self.register(refined, keyframes, registrations)

    def recover(self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera) -> ByCamera:
        """Recover the lost frames of each camera that has enough lost frames and enough localised frames."""
        recovered = self.runner.run_all(self._recovery_tasks(scene_map, registrations, keyframes))
        return {**registrations, **recovered}

    def clocks(self, scene_map: Artefact, registrations: ByCamera) -> Artefact:
        """Decide which clock each camera has, and report unknown and contradicted clocks to the user."""
        artefact = self._decide_clocks(scene_map, registrations)
        self.runner.report_notes(artefact, "clocks")
        return artefact

    def find_places(self, scene_map: Artefact, registrations: ByCamera) -> Job:
        """Find the places of the cameras whose place is unknown, and return the job with all places.

        If every place is known, or the job asks for no skeleton, the job is returned unchanged.

        Raises:
            EstimationError: The motion does not show which camera was where.
        """
        unplaced = self._job.capture.unplaced()
        if not unplaced or not has_body(self._job):
            return self._job
        clocks = {"": self._decide_clocks(scene_map, registrations)}
        if read_summary(clocks[""].path)["unknown"]:
            clocks = {
                camera.name: self._decide_clocks(scene_map, registrations, trunk=camera.name)
                for camera in unplaced
            }
        stated = [(camera.name, mount_of(camera.mount or camera.name)) for camera in self._capture.cameras]
        task = PlacesTask(
            stated={name: found[0] for name, found in stated if found is not None},
            clocks=refs_by_camera(clocks),
            registrations=refs_by_camera(registrations),
        )
        artefact = self.runner.run(make_task(task))
        self.runner.report_notes(artefact, "places")
        summary = read_summary(artefact.path)
        if not summary["places"]:
            raise _unknown_places([camera.name for camera in unplaced], summary["reason"])
        self._job = self._job.with_places(summary["places"])
        self._capture = self._job.capture
        del self._body  # It was made for the cameras whose place was known.
        return self._job

    def use_sensors(self, registrations: ByCamera) -> ByCamera:
        """Use the inertial sensors of the cameras that have telemetry, and report notes to the user.

        Without telemetry, or if all uses are switched off, the registrations are returned unchanged. The
        telemetry of cameras that stabilised their pictures is always read: it shows how they are turned.
        """
        off = {
            field: False
            for field, mechanism in (("gaps", Mechanism.GAP_FILLING), ("smoothing", Mechanism.SENSOR_PATH))
            if not is_on(mechanism)
        }
        options = self._job.telemetry.model_copy(update=off)
        is_used = options.gravity or options.smoothing or options.gaps or options.gps
        named = self._stabilised | (self._with_telemetry if is_used else frozenset())
        cameras = [camera for camera in self._capture.cameras if camera.stabilised or camera.name in named]
        tasks = []
        for own in cameras:
            ordered = [own, *(camera for camera in cameras if camera.name != own.name)]
            names = [camera.name for camera in ordered]
            task = InertialTask(
                options=options,
                cameras=tuple(names),
                capture=self._footage(ordered),
                registrations=refs_by_camera({name: registrations[name] for name in names}),
                samples={name: self._samples[name] for name in names if name in self._samples},
                stabilised=own.stabilised,
            )
            tasks.append(make_task(task, camera=own.name))
        used = self.runner.run_all(tasks)
        for artefact in used.values():
            self.runner.report_notes(artefact, "registration")
        return {**registrations, **used}

    def map_lost_parts(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> tuple[Artefact, ByCamera]:
        """Map the parts of the videos that no path contains, and localise their frames in these maps.

        Returns:
            The artefact of all maps, and the registrations, which name these frames and hold their poses.
            Both are unchanged if there are no further maps.
        """
        summaries = [read_summary(artefact.path) for artefact in registrations.values()]
        lost = [summary["frames"] - summary["localised"] for summary in summaries]
        is_empty = self._map_failure is not None
        if is_empty or sum(lost) < LEAST_MAPPED or not is_on(Mechanism.FURTHER_MAPS):
            return scene_map, registrations
        task = FurtherMapsTask(
            options=self._job.map,
            capture=self._footage(),
            keyframes=refs_by_camera(keyframes),
            map=artefact_ref(scene_map),
            registrations=refs_by_camera(registrations),
        )
        further = self.runner.run(make_task(task, threads=self._threads))
        if not read_summary(further.path)["further"]:
            return scene_map, registrations
        found = self.runner.run_all(
            make_task(
                FurtherPosesTask(
                    options=self._job.registration,
                    capture=self._footage([camera]),
                    keyframes=refs_by_camera({camera.name: keyframes[camera.name]}),
                    map=artefact_ref(further),
                    registration=artefact_ref(registrations[camera.name]),
                ),
                camera=camera.name,
                threads=threads,
            )
            for camera, threads in zip(self._capture.cameras, self.runner.threads_per_camera(), strict=True)
        )
        return further, found

    def compare_with_tracks(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> ByCamera:
        """Compare the final paths with the tracks of the videos, and return the artefact of each camera."""
        return self.runner.run_all(
            make_task(
                LinksTask(
                    keyframes=artefact_ref(keyframes[name]),
                    map=artefact_ref(scene_map),
                    registration=artefact_ref(registration),
                ),
                camera=name,
            )
            for name, registration in registrations.items()
        )

    def with_freed_lenses(self, links: ByCamera) -> Flow | None:
        """Return the flow of the same job with unknown lenses, for cameras whose path the video contradicts.

        A given lens that is some percent wrong bends the map, and a map of few points does not show it. A
        wrong lens is the first suspect. The flow shares the tasks and records of this one.

        Returns:
            None if no path of a camera with a given lens is contradicted.
        """
        given = {
            camera.name: camera.calibration.camera()
            for camera in self._job.capture.cameras
            if isinstance(camera.calibration, Calibration)
            and contradicted_share(read_summary(links[camera.name].path)) > MAX_CONTRADICTED
        }
        if not given or not is_on(Mechanism.FREED_LENSES):
            return None
        self.runner.note(
            f"{', '.join(given)}: the video contradicts the path with the given lens; if the video "
            "determines the lens, the paths are computed once more with that lens",
            "map",
        )
        out = copy.copy(self)
        out.freed = {name: lens.focal_px / lens.width_px for name, lens in given.items()}
        out._job = self._job.model_copy(update={"capture": _with_unknown_lenses(self._job.capture, given)})
        out._capture = _with_unknown_lenses(self._capture, given)
        out._map_round, out._map_failure = 0, None
        out.identify_videos()
        return out

    def shows_lenses(self, keyframes: ByCamera) -> bool:
        """Return whether the tracks of the videos determine all freed lenses."""
        return all(read_summary(keyframes[name].path)["lens"] for name in self.freed)

    def measure_rotations(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera, links: ByCamera
    ) -> tuple[ByCamera, ByCamera]:
        """Measure the rotations of the cameras whose positions say nothing, and withdraw these positions.

        A job with a body keeps the positions: the body needs them, and its scale can make them certain.

        Returns:
            The registrations, and what the tracks show about their paths.

        Raises:
            EstimationError: There is no map, and the cameras move.
        """
        if not self._may_be_rotations:
            return registrations, links
        names = without_positions({name: read_summary(each.path) for name, each in links.items()})
        measured = self.runner.run_all(
            make_task(
                RotationsTask(
                    capture=self._footage([camera]),
                    keyframes=refs_by_camera({camera.name: keyframes[camera.name]}),
                    map=artefact_ref(scene_map),
                    registration=artefact_ref(registrations[camera.name]),
                ),
                camera=camera.name,
                threads=threads,
            )
            for camera, threads in zip(self._capture.cameras, self.runner.threads_per_camera(), strict=True)
            if camera.name in names
        )
        turned = {name: each for name, each in measured.items() if read_summary(each.path)["rotations"]}
        if self._map_failure is not None and not turned:
            raise self._map_failure
        again = self.compare_with_tracks(scene_map, turned, keyframes)
        return {**registrations, **turned}, {**links, **again}

    @property
    def _may_be_rotations(self) -> bool:
        """True if the job can have rotations without positions as its result."""
        return not has_body(self._job) and is_on(Mechanism.PURE_ROTATION)

    def merge(
        self, scene_map: Artefact, registrations: ByCamera, clocks: Artefact, keyframes: ByCamera
    ) -> Artefact:
        """Solve the motion of the skeleton in the world.

        Raises:
            EstimationError: The data do not support a skeleton.
        """
        assert self._body is not None
        footage = BoardFootage(capture=self._footage(), keyframes=refs_by_camera(keyframes))
        task = MergeTask(
            options=self._job.merge,
            map=artefact_ref(scene_map),
            registrations=refs_by_camera(registrations),
            clocks=artefact_ref(clocks),
            body=self._body,
            footage=None if self._job.merge.marker_board is None else footage,
        )
        modules = [STAGES["preview"].modules] if self._job.export.preview else []
        preload = self._preload(modules, ["fill", "export", "report", "preview"])
        artefact = self.runner.run(make_task(task, threads=self._threads), preload)
        self.runner.report_notes(artefact, "merge")
        return artefact

    def fill(self, merged: Artefact) -> Artefact:
        """Pose the joints that no camera measured, and return the artefact of the motion of all joints."""
        task = FillTask(mode=self._job.fill, merge=artefact_ref(merged))
        return self.runner.run(make_task(task, threads=self._threads))

    def export(self, results: StageResults) -> Artefact:
        """Write the result files and return their artefact.

        Args:
            results: The results of the stages before the export.
        """
        assert results.map is not None
        assert results.clocks is not None
        capture = (results.job or self._job).capture
        task = ExportTask(
            options=self._job.export,
            take=self._job.name,
            capture=capture_ref(capture, self._cameras),
            map=artefact_ref(results.map),
            registrations=refs_by_camera(results.registrations),
            clocks=artefact_ref(results.clocks),
            keyframes=refs_by_camera(results.keyframes),
            links=refs_by_camera(results.links),
            merge=optional_ref(results.filled),
            failure=None if results.failure is None else results.failure.message,
            freed=self.freed,
            segments=tuple(tuple(camera.name for camera in cameras) for cameras in capture.segments()),
        )
        artefact = self.runner.run(make_task(task, threads=self._threads))
        self.runner.report_notes(artefact, "export")
        return artefact

    def undistort(self, results: StageResults, exported: Artefact, cameras: Sequence[str]) -> ByCamera:
        """Write the undistorted clip of each of these cameras, and return the artefact of each camera.

        Args:
            results: The results of the stages before the export.
            exported: The artefact of the result files, which contain the facts about the cameras.
            cameras: Names of the cameras.
        """
        assert results.map is not None
        return self.runner.run_all(
            make_task(
                UndistortTask(
                    camera=camera.name,
                    capture=self._footage([camera]),
                    map=artefact_ref(results.map),
                    export=artefact_ref(exported),
                ),
                camera=camera.name,
            )
            for camera in self._capture.cameras
            if camera.name in cameras
        )

    def start_preview(self, results: StageResults) -> Future[Artefact] | None:
        """Start to render the video of the results while later stages run.

        Returns:
            The future of the video's artefact; None if this run does not render the video.
        """
        if self._settings.until not in ("", "preview") or results.map is None:
            return None
        assert results.clocks is not None
        task = preview_task(self._job, results, results.map, results.clocks, self._cameras)
        return self.runner.start(partial(self.runner.run, make_task(task, threads=self._threads)))

    def report(self, results: StageResults, stopped_by: BodycapError | None = None) -> Artefact:
        """Write the report of all results and return its artefact.

        Args:
            results: The results of the stages that have finished.
            stopped_by: The error that stopped the job; None if the job was not stopped.
        """
        failure = results.describe_failure(stopped_by or results.failure)
        digests = self._settings.store.digests
        task = report_task(self._job, results, self._cameras, digests, failure)
        return self.runner.run(make_task(task))

    def _decide_clocks(self, scene_map: Artefact, registrations: ByCamera, trunk: str = "") -> Artefact:
        """Decide which clock each camera has, and return the artefact of the clocks.

        Args:
            scene_map: The artefact of the map.
            registrations: The registration of each camera, by camera name.
            trunk: Name of the camera that is taken for the one on the trunk; "" for the places of the job.
        """
        distances = [] if self._body is None else camera_distances(self._body)
        capture = self._job.capture
        stated = stated_clocks(capture)
        if trunk:
            stated[trunk] = replace(stated[trunk], role=TRUNK_ROLES[0])
        task = ClocksTask(
            capture=capture_ref(capture, self._cameras),
            stated=stated,
            common=capture.clocks,
            rig=capture.rig,
            sound=optional_ref(None if self._sound is None else self._sound.result()),
            map=artefact_ref(scene_map),
            registrations=refs_by_camera(registrations),
            reach=tuple(
                CameraDistance(first=first, second=second, least_m=least_m, most_m=most_m)
                for first, second, least_m, most_m in distances
            ),
        )
        return self.runner.run(make_task(task))

    def _footage(self, cameras: Sequence[CameraConfig] | None = None) -> CaptureRef:
        """Return the videos of all or some cameras."""
        return capture_ref(self._capture, self._cameras, cameras)

    def _start_sound(self) -> Future[Artefact]:
        """Compare the sound of the cameras, beside the keyframes if there are threads for both."""
        compare = partial(self._compare_sound, make_task(SoundTask(capture=self._footage())))
        if self._threads > 1:
            return self.runner.start(compare)
        done = Future[Artefact]()
        try:
            done.set_result(compare())
        except NotStored as error:
            # As in another thread, the stages that do not use the sound go on.
            done.set_exception(error)
        return done

    def _compare_sound(self, task: Task) -> Artefact:
        """Compare the sound; report which clocks only the motion can determine, and what may be missing."""
        from bodycap_batch.clocks import clocks_from_motion_notes

        artefact = self.runner.run(task)
        capture = known_from_sound(self._job.capture, artefact.path)
        for note in clocks_from_motion_notes(capture, with_body=has_body(self._job)):
            self.runner.note(note, "clocks")
        return artefact

    @property
    def sound(self) -> Future[Artefact] | None:
        """The artefact of the sound; None before the check, or if there is only one camera."""
        return self._sound

    def _apply_sound_offsets(self) -> None:
        """Select the frames between start_s and end_s with the clocks that are known before the map.

        All frames of a camera with an unknown clock are used. A note says so.
        """
        sound = None if self._sound is None else self._sound.result()
        self._capture = known_from_sound(self._job.capture, None if sound is None else sound.path)
        for camera in self._capture.cameras:
            if camera.offset_s is None:
                note = (
                    f"{camera.name}: neither the job nor the sound gives its clock, so start_s and "
                    "end_s do not apply to it and all its frames are used; state offset_s to use a part of it"
                )
                self._settings.listener(Event(kind="note", stage="clocks", what=f"note: {note}"))
        self.identify_videos()

    @cached_property
    def _body(self) -> BodyInput | None:
        """The body of the job; None if the job asks for no skeleton."""
        return body_input(self._job, self._settings.store.digests) if has_body(self._job) else None

    def identify_videos(self) -> None:
        """Determine the digest of each camera's frames, for a run that starts with stored results.

        Raises:
            BodycapError: A video cannot be read, or the job was stopped.
        """
        self._cameras = camera_digests(
            self._capture, self._settings.store.digests, self._settings.listener, self._settings.cancelled
        )

    def _check_task(self) -> Task:
        self.identify_videos()
        # Each run checks the installed libraries: they can change after the check stage is stored.
        require_libraries(self._job.export.formats)
        # Places that an earlier run found are not part of the key: the check of that run did not know them.
        found = {camera.name for camera in self._capture.cameras if camera.mount_source is not None}
        clocks, body = stated_clocks(self._job.capture), self._body
        if body is not None:
            body = replace(body, mounts=tuple(item for item in body.mounts if item.camera not in found))
        task = CheckTask(
            job=self._job,
            cameras=self._cameras,
            clocks={
                name: replace(each, role=None) if name in found else each for name, each in clocks.items()
            },
            body=body,
            formats=self._job.export.formats,
            names=self._job.export.names,
            limits=self._settings.limits,
        )
        return make_task(task, threads=self._threads)

    def _extend(
        self, scene_map: Artefact, wanted: Mapping[str, Sequence[int]], keyframes: ByCamera
    ) -> Artefact:
        """Add the requested frames of each camera to the map as keyframes; return the new map's artefact."""
        self._map_round += 1
        task = ExtendTask(
            options=self._job.map,
            capture=self._footage(),
            keyframes=refs_by_camera(keyframes),
            map=artefact_ref(scene_map),
            extra={name: tuple(frames) for name, frames in wanted.items()},
        )
        return self.runner.run(make_task(task, map_round=self._map_round, threads=self._threads))

    def _recovery_tasks(
        self, scene_map: Artefact, registrations: ByCamera, keyframes: ByCamera
    ) -> Iterator[Task]:
        """Yield one task for every camera with enough lost frames and enough localised frames."""
        for own in self._capture.cameras:
            summary = read_summary(registrations[own.name].path)
            if not is_on(Mechanism.RECOVERY):
                continue
            if not LEAST_POSED <= summary["localised"] <= summary["frames"] - LEAST_LOST:
                continue
            ordered = [own, *(camera for camera in self._capture.cameras if camera.name != own.name)]
            names = [camera.name for camera in ordered]
            task = RecoverTask(
                options=self._job.registration,
                cameras=tuple(names),
                capture=self._footage(ordered),
                keyframes=refs_by_camera({name: keyframes[name] for name in names}),
                map=artefact_ref(scene_map),
                registrations=refs_by_camera({name: registrations[name] for name in names}),
            )
            yield make_task(task, camera=own.name, threads=min(self._threads, _MAX_RECOVERY_THREADS))


def _read_ahead(stages: Sequence[str]) -> None:
    """Read what this process needs later: the code of stages, and a library that judges the results."""
    for name in stages:
        STAGES[name].program.versions()
    importlib.import_module("scipy.special")


def _unknown_places(cameras: Sequence[str], reason: str) -> EstimationError:
    stated = " ".join(f"--camera {name}=PLACE" for name in cameras)
    return EstimationError(
        f"the motion does not show which camera was at which place: {reason}",
        field="capture.places",
        hint=f"look at the videos, and give the places: {stated} (one of {', '.join(MOTION_PLACES)}); the "
        "stages that are finished are not computed again",
    )


def _with_unknown_lenses(capture: CaptureConfig, cameras: Container[str]) -> CaptureConfig:
    """Return a capture in which the lenses of some cameras are unknown."""
    changed = tuple(
        camera.model_copy(update={"calibration": "auto"}) if camera.name in cameras else camera
        for camera in capture.cameras
    )
    return capture.model_copy(update={"cameras": changed})


def _posed_frames(registrations: ByCamera) -> int:
    """Return the number of frames of all cameras that are localised, or whose pose was withdrawn."""
    summaries = [read_summary(artefact.path) for artefact in registrations.values()]
    return sum(int(summary["localised"]) + int(summary["contradicted"]) for summary in summaries)
