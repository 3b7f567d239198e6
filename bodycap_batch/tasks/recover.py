"""The task that recovers the lost frames of a camera, after its poses are final."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.config.options import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import RIG_POSES
from bodycap_batch.tasks.registration import NOT_ROUNDS, save_registration
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage, read_summary

if TYPE_CHECKING:
    from bodycap_batch.model.scene import Trajectory

_MEMORY_MB = 900
"""Memory to reserve, MB: as many keyframes and frames as recovery holds at most, at half a megabyte each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoverTask:
    """Search for the poses of one camera's lost frames.

    Attributes:
        options: Options of registration.
        cameras: Names of all cameras: the task's own camera, then the others.
        capture: These cameras, in this order.
        keyframes: By camera.
        map: The map.
        registrations: By camera, in this order.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    cameras: tuple[str, ...]
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]


def run_recover(task: RecoverTask, context: StageContext, files: Path) -> None:
    """Recover the camera's lost frames; store all its poses."""
    from bodycap_batch.formats.bundle import read_bundle, write_bundle
    from bodycap_batch.model.relative_pose import RigPoses
    from bodycap_batch.registration import RigCamera, recover_lost, settled, without_contradicted

    context.check_cancelled()
    capture, paths = load_capture(task.capture, task.keyframes), paths_of(task.registrations.values())
    selection = load_keyframes(task.keyframes[task.cameras[0]].path)
    found = load_registration(paths[0])
    maps = load_map(task.map.path).maps
    scene = next(each for each in maps if each.gauge == found.trajectory.gauge)
    trajectories: list[Trajectory] = []

    def everyone() -> Iterator[RigCamera]:
        # One at a time: the tracks of a long video take most of an artefact's memory.
        for camera, path in zip(capture.cameras, paths, strict=True):
            each = RigCamera(camera=camera, found=load_registration(path))
            trajectories.append(each.found.trajectory)
            yield each

    scene = without_contradicted(scene, everyone(), selection, task.options)
    in_rig = (paths[0] / f"{RIG_POSES}.json").exists()
    if not in_rig:
        own = RigCamera(camera=capture.cameras[0], found=found)
        scene, found = settled(own, trajectories[1:], scene, selection, task.options)
    found = recover_lost(found, scene, capture, task.options, context)
    save_registration(found, capture.cameras[0], files, rolling=read_summary(paths[0])["rolling"])
    if in_rig:
        write_bundle(read_bundle(RigPoses, paths[0], RIG_POSES), files, RIG_POSES)


RECOVER = Stage(
    name="recover",
    task=RecoverTask,
    function=run_recover,
    libraries=(*VISION_LIBRARIES, "pycolmap"),
    modules=(*VISION_MODULES, "pycolmap"),
    memory_mb=_MEMORY_MB,
)
