"""The stages of a job as functions: each makes the tasks of a stage and runs them.

They return artefacts, or the results with them; `check` writes the facts into the results. `run.run_stages`
calls them in order.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial

from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.lost_frames import LEAST_LOST, LEAST_MAPPED, LEAST_POSED
from bodycap_batch.config.models import CameraConfig
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
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.settings import Settings
from bodycap_batch.pipeline.stage_results import StageResults, preview_task, report_task
from bodycap_batch.pipeline.stage_runner import StageRunner
from bodycap_batch.pipeline.task_keys import make_task
from bodycap_batch.runner import NotStored, Task
from bodycap_batch.runner.child_pool import NOTHING_TO_LOAD, Preload
from bodycap_batch.store.artefacts import Artefact
from bodycap_batch.tasks.body import camera_distances
from bodycap_batch.tasks.check import CheckTask
from bodycap_batch.tasks.clocks import ClocksTask
from bodycap_batch.tasks.export import ExportTask
from bodycap_batch.tasks.fill import FillTask
from bodycap_batch.tasks.further import FurtherMapsTask, FurtherPosesTask
from bodycap_batch.tasks.inertial import InertialTask
from bodycap_batch.tasks.inputs import BodyInput, stated_clocks
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
"""The artefact of each camera, by camera name."""


def identify_videos(settings: Settings, facts: JobFacts) -> JobFacts:
    """Return the facts with the digest of each camera's frames.

    Raises:
        BodycapError: A video cannot be read, or the job was stopped.
    """
    digests = camera_digests(facts.capture, settings.store.digests, settings.listener, settings.cancelled)
    return replace(facts, digests=digests)


def check(runner: StageRunner, results: StageResults) -> None:
    """Check the job before any long computation, and report notes to the user.

    The videos are identified, and `results` gets the facts about them. With several cameras, the comparison
    of their sound starts.

    Raises:
        BodycapError: The job, a video or a calibration cannot be used.
    """
    settings = runner.settings
    try:
        results.facts = facts = identify_videos(settings, results.facts)
        task = _check_task(settings, facts)
    except (CaptureError, JobError):
        settings.listener(Event(kind="failed", stage="check"))
        raise
    preload = Preload(modules=[STAGES["keyframes"].modules] * (runner.parallel_tasks - 1))
    artefact = runner.run(task, preload)
    summary = read_summary(artefact.path)
    runner.expect_frames(int(summary["frames"]), int(summary.get("large_frames", 0)))
    found = {camera.name: samples_input(camera, settings.store.digests) for camera in facts.capture.cameras}
    samples = {name: file for name, file in found.items() if file is not None}
    results.facts = facts = replace(
        facts,
        samples=samples,
        telemetry=frozenset(summary.get("telemetry", ())) | samples.keys(),
        stabilised=frozenset(summary.get("stabilised", ())),
    )
    runner.report_notes(artefact, "check")
    if len(facts.capture.cameras) > 1:
        results.sound = _start_sound(runner, facts)
    if facts.capture.start_s is not None or facts.capture.end_s is not None:
        results.facts = _with_known_clocks(settings, facts, results.sound)


def select_keyframes(runner: StageRunner, results: StageResults) -> ByCamera:
    """Select the keyframes of every camera. Damaged and frozen frames are reported to the user."""
    facts = results.facts

    def task(camera: CameraConfig) -> KeyframesTask:
        with_gyro = facts.job.telemetry.tracking and camera.name in facts.telemetry
        return KeyframesTask(
            options=facts.job.keyframes,
            capture=facts.footage([camera]),
            with_gyro=with_gyro,
            samples=facts.samples.get(camera.name) if with_gyro else None,
        )

    selected = _run_per_camera(runner, facts, task)
    for artefact in selected.values():
        runner.report_notes(artefact, "keyframes")
    return selected


def build_map(runner: StageRunner, results: StageResults) -> Artefact:
    """Build the map of all keyframes.

    Without a body, the map may be empty (see `map_failure`): `measure_rotations` then has the last word.

    Raises:
        EstimationError: There is no map.
    """
    facts = results.facts
    task = MapTask(
        options=facts.job.map,
        capture=facts.footage(),
        keyframes=refs_by_camera(results.keyframes),
        may_be_empty=_may_be_rotations(facts),
    )
    body = ["merge", "fill"] if has_body(facts.job) else []
    later = ["registration", "clocks", "links", *body, "export", "report"]
    # Features and matches keep all cores busy. After them, mapping keeps one core busy. Only then does
    # another core load the libraries of later stages. Evidence: docs/decisions/pipeline.md.
    modules = [module for name in later for module in STAGES[name].modules]
    preload = _preload(runner, [modules], ["registration", "clocks", *body[:1]], step=RECONSTRUCTION)
    artefact = runner.run(make_task(task, threads=runner.settings.threads), preload)
    if runner.settings.until == "map" and (failure := map_failure(artefact)) is not None:
        raise failure
    return artefact


def map_failure(scene_map: Artefact) -> EstimationError | None:
    """Return why a map is empty; None for a map that is not empty."""
    failure = read_summary(scene_map.path).get("failure")
    return None if failure is None else EstimationError(failure["message"], hint=failure["hint"])


def register(runner: StageRunner, results: StageResults) -> ByCamera:
    """Register every frame of every camera against the map, with the tracks of earlier registrations."""
    facts, scene_map = results.facts, artefact_ref(results.scene_map)

    def task(camera: CameraConfig) -> RegistrationTask:
        return RegistrationTask(
            options=facts.job.registration,
            capture=facts.footage([camera]),
            keyframes=refs_by_camera({camera.name: results.keyframes[camera.name]}),
            map=scene_map,
            previous=optional_ref(results.registrations.get(camera.name)),
        )

    return _run_per_camera(runner, facts, task, map_round=results.map_round)


def extend_map(runner: StageRunner, results: StageResults) -> StageResults:
    """Add keyframes at times of lost frames and register again, until no further frame is localised.

    Returns:
        The results with the extended map and the registrations against this map. A round that fails, or that
        loses frames, is not used. Frames whose pose a round withdraws, because they contradict the map, were
        wrong before and do not count as lost.
    """
    facts = results.facts
    for _ in range(facts.job.registration.rounds if is_on(Mechanism.EXTENSION) else 0):
        summaries = {name: read_summary(artefact.path) for name, artefact in results.registrations.items()}
        wanted = {name: summary["wanted"] for name, summary in summaries.items() if summary["wanted"]}
        if not wanted:
            break
        results = replace(results, map_round=results.map_round + 1)
        task = ExtendTask(
            options=facts.job.map,
            capture=facts.footage(),
            keyframes=refs_by_camera(results.keyframes),
            map=artefact_ref(results.scene_map),
            extra={name: tuple(frames) for name, frames in wanted.items()},
        )
        try:
            extended = runner.run(
                make_task(task, map_round=results.map_round, threads=runner.settings.threads)
            )
        except EstimationError as error:
            cause = "the map could not be extended to localise lost frames"
            runner.note(f"{cause}, so the earlier map is kept: {error.message}", "extend")
            break
        larger = replace(results, map=extended)
        larger.registrations = register(runner, larger)
        gained = _posed_frames(larger.registrations) - _posed_frames(results.registrations)
        if gained < 0:
            break
        # The new map is used even if no further frame is localised: misregistered keyframes have new poses in
        # the new map.
        results = larger
        if gained == 0:
            break
    return results


def refine_map(runner: StageRunner, results: StageResults) -> StageResults:
    """Remove the deformation of the map that rolling shutters cause, and solve all poses again.

    Returns:
        The results with the refined map and the registrations against it. If no camera has a rolling shutter,
        both are unchanged. If readout times are unknown, and the keyframes show no rolling shutter, the
        registrations are unchanged.
    """
    before = read_summary(results.scene_map.path)
    if not before["rolling"] or not is_on(Mechanism.REFINEMENT):
        return results
    task = RefineTask(
        options=results.facts.job.map,
        capture=results.facts.footage(),
        map=artefact_ref(results.scene_map),
        registrations=refs_by_camera(results.registrations),
    )
    refined = replace(results, map=runner.run(make_task(task, threads=runner.settings.threads)))
    if read_summary(refined.scene_map.path)["corrected"] or before["corrected"]:
        refined.map_round += 1
        refined.registrations = register(runner, refined)
    return refined


def recover(runner: StageRunner, results: StageResults) -> ByCamera:
    """Recover the lost frames of each camera that has enough lost frames and enough localised frames."""
    facts, keyframes, registrations = results.facts, results.keyframes, results.registrations
    scene_map = artefact_ref(results.scene_map)

    def tasks() -> Iterator[Task]:
        for own in facts.capture.cameras if is_on(Mechanism.RECOVERY) else ():
            summary = read_summary(registrations[own.name].path)
            if not LEAST_POSED <= summary["localised"] <= summary["frames"] - LEAST_LOST:
                continue
            ordered = _first_of(facts.capture.cameras, own)
            names = [camera.name for camera in ordered]
            task = RecoverTask(
                options=facts.job.registration,
                cameras=tuple(names),
                capture=facts.footage(ordered),
                keyframes=refs_by_camera({name: keyframes[name] for name in names}),
                map=scene_map,
                registrations=refs_by_camera({name: registrations[name] for name in names}),
            )
            threads = min(runner.settings.threads, _MAX_RECOVERY_THREADS)
            yield make_task(task, camera=own.name, threads=threads)

    return {**registrations, **runner.run_all(tasks())}


def decide_clocks(runner: StageRunner, results: StageResults, trunk: str = "") -> Artefact:
    """Decide which clock each camera has.

    Args:
        runner: Runs the task.
        results: The results up to the paths of the cameras.
        trunk: Name of the camera that is taken for the one on the trunk; "" for the places of the job.
    """
    facts, sound = results.facts, results.sound
    capture, body = facts.job.capture, _body_of(runner.settings, facts)
    stated = stated_clocks(capture)
    if trunk:
        stated[trunk] = replace(stated[trunk], role=TRUNK_ROLES[0])
    task = ClocksTask(
        capture=capture_ref(capture, facts.digests),
        stated=stated,
        common=capture.clocks,
        rig=capture.rig,
        sound=optional_ref(None if sound is None else sound.result()),
        map=artefact_ref(results.scene_map),
        registrations=refs_by_camera(results.registrations),
        reach=() if body is None else tuple(camera_distances(body)),
    )
    return runner.run(make_task(task))


def find_places(runner: StageRunner, results: StageResults) -> JobFacts:
    """Find the places of the cameras whose place is unknown, and return the facts with all places.

    If every place is known, or the job asks for no skeleton, the facts are returned unchanged.

    Raises:
        EstimationError: The motion does not show which camera was where.
    """
    facts = results.facts
    unplaced = facts.job.capture.unplaced()
    if not unplaced or not has_body(facts.job):
        return facts
    clocks = {"": decide_clocks(runner, results)}
    if read_summary(clocks[""].path)["unknown"]:
        clocks = {camera.name: decide_clocks(runner, results, trunk=camera.name) for camera in unplaced}
    stated = [(camera.name, mount_of(camera.mount or camera.name)) for camera in facts.capture.cameras]
    task = PlacesTask(
        stated={name: found[0] for name, found in stated if found is not None},
        clocks=refs_by_camera(clocks),
        registrations=refs_by_camera(results.registrations),
    )
    artefact = runner.run(make_task(task))
    runner.report_notes(artefact, "places")
    summary = read_summary(artefact.path)
    if not summary["places"]:
        raise _unknown_places([camera.name for camera in unplaced], summary["reason"])
    return facts.with_places(summary["places"])


def use_sensors(runner: StageRunner, results: StageResults) -> ByCamera:
    """Use the inertial sensors of the cameras that have telemetry, and report notes to the user.

    Without telemetry, or if all uses are switched off, the registrations are returned unchanged. The
    telemetry of cameras that stabilised their pictures is always read: it shows how they are turned.
    """
    facts, registrations = results.facts, results.registrations
    off = {
        field: False
        for field, mechanism in (("gaps", Mechanism.GAP_FILLING), ("smoothing", Mechanism.SENSOR_PATH))
        if not is_on(mechanism)
    }
    options = facts.job.telemetry.model_copy(update=off)
    is_used = options.gravity or options.smoothing or options.gaps or options.gps
    named = facts.stabilised | (facts.telemetry if is_used else frozenset())
    cameras = [camera for camera in facts.capture.cameras if camera.stabilised or camera.name in named]
    tasks = []
    for own in cameras:
        ordered = _first_of(cameras, own)
        names = [camera.name for camera in ordered]
        task = InertialTask(
            options=options,
            cameras=tuple(names),
            capture=facts.footage(ordered),
            registrations=refs_by_camera({name: registrations[name] for name in names}),
            samples={name: facts.samples[name] for name in names if name in facts.samples},
            stabilised=own.stabilised,
        )
        tasks.append(make_task(task, camera=own.name))
    used = runner.run_all(tasks)
    for artefact in used.values():
        runner.report_notes(artefact, "registration")
    return {**registrations, **used}


def map_lost_parts(runner: StageRunner, results: StageResults) -> tuple[Artefact, ByCamera]:
    """Map the parts of the videos that no path contains, and localise their frames in these maps.

    Returns:
        All maps, and the registrations, which name these frames and hold their poses. Both are unchanged if
        there are no further maps.
    """
    facts, scene_map, registrations = results.facts, results.scene_map, results.registrations
    summaries = [read_summary(artefact.path) for artefact in registrations.values()]
    lost = sum(summary["frames"] - summary["localised"] for summary in summaries)
    if lost < LEAST_MAPPED or map_failure(scene_map) is not None or not is_on(Mechanism.FURTHER_MAPS):
        return scene_map, registrations
    task = FurtherMapsTask(
        options=facts.job.map,
        capture=facts.footage(),
        keyframes=refs_by_camera(results.keyframes),
        map=artefact_ref(scene_map),
        registrations=refs_by_camera(registrations),
    )
    further = runner.run(make_task(task, threads=runner.settings.threads))
    if not read_summary(further.path)["further"]:
        return scene_map, registrations

    def poses(camera: CameraConfig) -> FurtherPosesTask:
        return FurtherPosesTask(
            options=facts.job.registration,
            capture=facts.footage([camera]),
            keyframes=refs_by_camera({camera.name: results.keyframes[camera.name]}),
            map=artefact_ref(further),
            registration=artefact_ref(registrations[camera.name]),
        )

    return further, _run_per_camera(runner, facts, poses)


def compare_with_tracks(runner: StageRunner, results: StageResults, registrations: ByCamera) -> ByCamera:
    """Compare the final paths with the tracks of the videos."""
    tasks = {
        name: LinksTask(
            keyframes=artefact_ref(results.keyframes[name]),
            map=artefact_ref(results.scene_map),
            registration=artefact_ref(registration),
        )
        for name, registration in registrations.items()
    }
    return runner.run_all(make_task(task, camera=name) for name, task in tasks.items())


def contradicted_lenses(runner: StageRunner, results: StageResults) -> Mapping[str, float]:
    """Return the given focal length over the width of each camera whose path the video contradicts, by name.

    A given lens that is some percent wrong bends the map, and a map of few points does not show it. A wrong
    lens is the first suspect.
    """
    given = {
        camera.name: camera.calibration.camera()
        for camera in results.facts.job.capture.cameras
        if isinstance(camera.calibration, Calibration)
        and contradicted_share(read_summary(results.links[camera.name].path)) > MAX_CONTRADICTED
    }
    if not given or not is_on(Mechanism.FREED_LENSES):
        return {}
    runner.note(
        f"{', '.join(given)}: the video contradicts the path with the given lens; if the video "
        "determines the lens, the paths are computed once more with that lens",
        "map",
    )
    return {name: lens.focal_px / lens.width_px for name, lens in given.items()}


def measure_rotations(runner: StageRunner, results: StageResults) -> tuple[ByCamera, ByCamera]:
    """Measure the rotations of the cameras whose positions say nothing, and withdraw these positions.

    A job with a body keeps the positions: the body needs them, and its scale can make them certain.

    Returns:
        The registrations, and what the tracks show about their paths.

    Raises:
        EstimationError: There is no map, and the cameras move.
    """
    facts, registrations, links = results.facts, results.registrations, results.links
    if not _may_be_rotations(facts):
        return registrations, links

    def task(camera: CameraConfig) -> RotationsTask:
        return RotationsTask(
            capture=facts.footage([camera]),
            keyframes=refs_by_camera({camera.name: results.keyframes[camera.name]}),
            map=artefact_ref(results.scene_map),
            registration=artefact_ref(registrations[camera.name]),
        )

    names = without_positions({name: read_summary(each.path) for name, each in links.items()})
    measured = _run_per_camera(runner, facts, task, names=names)
    turned = {name: each for name, each in measured.items() if read_summary(each.path)["rotations"]}
    if not turned and (failure := map_failure(results.scene_map)) is not None:
        raise failure
    again = compare_with_tracks(runner, results, turned)
    return {**registrations, **turned}, {**links, **again}


def merge(runner: StageRunner, results: StageResults) -> Artefact:
    """Solve the motion of the skeleton in the world.

    Raises:
        EstimationError: The data do not support a skeleton.
    """
    assert results.clocks is not None
    job = results.facts.job
    footage = BoardFootage(capture=results.facts.footage(), keyframes=refs_by_camera(results.keyframes))
    task = MergeTask(
        options=job.merge,
        map=artefact_ref(results.scene_map),
        registrations=refs_by_camera(results.registrations),
        clocks=artefact_ref(results.clocks),
        body=body_input(job, runner.settings.store.digests),
        footage=None if job.merge.marker_board is None else footage,
    )
    modules = [STAGES["preview"].modules] if job.export.preview else []
    preload = _preload(runner, modules, ["fill", "export", "report", "preview"])
    artefact = runner.run(make_task(task, threads=runner.settings.threads), preload)
    runner.report_notes(artefact, "merge")
    return artefact


def fill(runner: StageRunner, results: StageResults) -> Artefact:
    """Pose the joints that no camera measured, and return the artefact of the motion of all joints."""
    assert results.merged is not None
    task = FillTask(mode=results.facts.job.fill, merge=artefact_ref(results.merged))
    return runner.run(make_task(task, threads=runner.settings.threads))


def export(runner: StageRunner, results: StageResults) -> Artefact:
    """Write the result files of the stages before the export."""
    assert results.clocks is not None
    facts = results.facts
    capture = facts.job.capture
    task = ExportTask(
        options=facts.job.export,
        take=facts.job.name,
        capture=capture_ref(capture, facts.digests),
        map=artefact_ref(results.scene_map),
        registrations=refs_by_camera(results.registrations),
        clocks=artefact_ref(results.clocks),
        keyframes=refs_by_camera(results.keyframes),
        links=refs_by_camera(results.links),
        merge=optional_ref(results.filled),
        failure=None if results.failure is None else results.failure.message,
        freed=facts.freed,
        segments=tuple(tuple(camera.name for camera in cameras) for cameras in capture.segments()),
    )
    artefact = runner.run(make_task(task, threads=runner.settings.threads))
    runner.report_notes(artefact, "export")
    return artefact


def undistort(
    runner: StageRunner, results: StageResults, exported: Artefact, cameras: Collection[str]
) -> ByCamera:
    """Write the undistorted clip of each of these cameras.

    Args:
        runner: Runs the tasks.
        results: The results of the stages before the export.
        exported: The artefact of the result files, which contain the facts about the cameras.
        cameras: Names of the cameras.
    """
    tasks = [
        UndistortTask(
            camera=camera.name,
            capture=results.facts.footage([camera]),
            map=artefact_ref(results.scene_map),
            export=artefact_ref(exported),
        )
        for camera in results.facts.capture.cameras
        if camera.name in cameras
    ]
    return runner.run_all(make_task(task, camera=task.camera) for task in tasks)


def start_preview(runner: StageRunner, results: StageResults) -> Future[Artefact] | None:
    """Start to render the video of the results while later stages run.

    Returns:
        The future of the video's artefact; None if this run does not render the video.
    """
    if runner.settings.until not in ("", "preview") or results.map is None:
        return None
    task = preview_task(results)
    return runner.start(partial(runner.run, make_task(task, threads=runner.settings.threads)))


def report(runner: StageRunner, results: StageResults, stopped_by: BodycapError | None = None) -> Artefact:
    """Write the report of the results of the stages that have finished.

    Args:
        runner: Runs the task.
        results: The results.
        stopped_by: The error that stopped the job; None if the job was not stopped.
    """
    task = report_task(results, runner.settings.store.digests, stopped_by)
    return runner.run(make_task(task))


def _check_task(settings: Settings, facts: JobFacts) -> Task:
    job = facts.job
    # Each run checks the installed libraries: they can change after the check stage is stored.
    require_libraries(job.export.formats)
    # Places that an earlier run found are not part of the key: the check of that run did not know them.
    found = {camera.name for camera in job.capture.cameras if camera.mount_source is not None}
    clocks, body = stated_clocks(job.capture), _body_of(settings, facts)
    if body is not None:
        body = replace(body, mounts=tuple(item for item in body.mounts if item.camera not in found))
    task = CheckTask(
        job=job,
        cameras=facts.digests,
        clocks={name: replace(each, role=None) if name in found else each for name, each in clocks.items()},
        body=body,
        formats=job.export.formats,
        names=job.export.names,
        limits=settings.limits,
    )
    return make_task(task, threads=settings.threads)


def _body_of(settings: Settings, facts: JobFacts) -> BodyInput | None:
    """Return the body of a job; None if the job asks for no skeleton."""
    return body_input(facts.job, settings.store.digests) if has_body(facts.job) else None


def _start_sound(runner: StageRunner, facts: JobFacts) -> Future[Artefact]:
    """Compare the sound of the cameras, beside the keyframes if there are threads for both."""
    compare = partial(_compare_sound, runner, facts)
    if runner.settings.threads > 1:
        return runner.start(compare)
    done = Future[Artefact]()
    try:
        done.set_result(compare())
    except NotStored as error:
        # As in another thread, the stages that do not use the sound go on.
        done.set_exception(error)
    return done


def _compare_sound(runner: StageRunner, facts: JobFacts) -> Artefact:
    """Compare the sound; report which clocks only the motion can determine, and what may be missing."""
    from bodycap_batch.clocks import clocks_from_motion_notes

    artefact = runner.run(make_task(SoundTask(capture=facts.footage())))
    capture = known_from_sound(facts.job.capture, artefact.path)
    for note in clocks_from_motion_notes(capture, with_body=has_body(facts.job)):
        runner.note(note, "clocks")
    return artefact


def _with_known_clocks(settings: Settings, facts: JobFacts, sound: Future[Artefact] | None) -> JobFacts:
    """Return facts that select the frames between start_s and end_s with the clocks known before the map.

    All frames of a camera with an unknown clock are used. A note says so.
    """
    capture = known_from_sound(facts.job.capture, None if sound is None else sound.result().path)
    for camera in capture.cameras:
        if camera.offset_s is None:
            note = (
                f"{camera.name}: neither the job nor the sound gives its clock, so start_s and "
                "end_s do not apply to it and all its frames are used; state offset_s to use a part of it"
            )
            settings.listener(Event(kind="note", stage="clocks", what=f"note: {note}"))
    return identify_videos(settings, replace(facts, capture=capture))


def _run_per_camera(
    runner: StageRunner,
    facts: JobFacts,
    task: Callable[[CameraConfig], object],
    *,
    map_round: int = 0,
    names: Collection[str] | None = None,
) -> ByCamera:
    """Run the task of each camera, or of those with these names. All cameras share the threads."""
    cameras = zip(facts.capture.cameras, runner.threads_per_camera(), strict=True)
    return runner.run_all(
        make_task(task(camera), camera=camera.name, map_round=map_round, threads=threads)
        for camera, threads in cameras
        if names is None or camera.name in names
    )


def _first_of(cameras: Sequence[CameraConfig], own: CameraConfig) -> list[CameraConfig]:
    """Return the cameras with one of them at the start."""
    return [own, *(camera for camera in cameras if camera.name != own.name)]


def _may_be_rotations(facts: JobFacts) -> bool:
    """Return True if the job can have rotations without positions as its result."""
    return not has_body(facts.job) and is_on(Mechanism.PURE_ROTATION)


def _preload(
    runner: StageRunner, modules: Sequence[Sequence[str]], next_stages: Sequence[str], step: str = ""
) -> Preload:
    """Return what an idle core does while a task runs: nothing if there is only one thread.

    Args:
        runner: Runs the task.
        modules: Modules that idle children load: one list of module names for each child.
        next_stages: Names of the stages whose code this process reads.
        step: Name of the step of the task at which this begins; "" to begin with the task.
    """
    if runner.settings.threads == 1:
        return NOTHING_TO_LOAD
    read_ahead = partial(runner.start_beside, partial(_read_ahead, next_stages))
    return Preload(modules=modules, step=step, then=read_ahead)


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


def _posed_frames(registrations: ByCamera) -> int:
    """Return the number of frames of all cameras that are localised, or whose pose was withdrawn."""
    summaries = [read_summary(artefact.path) for artefact in registrations.values()]
    return sum(int(summary["localised"]) + int(summary["contradicted"]) for summary in summaries)
