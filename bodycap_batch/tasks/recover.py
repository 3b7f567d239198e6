"""The task that looks for a camera's lost frames once more, when its poses are final."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, read_summary

if TYPE_CHECKING:
    from bodycap_batch.model.scene import Trajectory

_MEMORY_MB = 900
"""With as many keyframes and frames held as recovery allows, at half a megabyte each."""


def _recover(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.relative_pose import RigPoses
    from bodycap_batch.registration import RigCamera, recover_lost, settled, without_contradicted

    context.check_cancelled()
    capture, paths = load_capture(arguments), [Path(path) for path in arguments["registrations"]]
    options_ = RegistrationOptions.model_validate(options)
    selection = load_keyframes(arguments["selection"])
    found = load_registration(str(paths[0]))
    maps = load_map(arguments["map"]).maps
    scene = next(each for each in maps if each.gauge == found.trajectory.gauge)
    trajectories: list[Trajectory] = []

    def everyone() -> Iterator[RigCamera]:
        # One at a time: what was tracked in a long video takes most of an artefact's memory.
        for camera, path in zip(capture.cameras, paths, strict=True):
            each = RigCamera(camera=camera, found=load_registration(str(path)))
            trajectories.append(each.found.trajectory)
            yield each

    scene = without_contradicted(scene, everyone(), selection, options_)
    in_rig = (paths[0] / f"{RIG_POSES}.json").exists()
    if not in_rig:
        own = RigCamera(camera=capture.cameras[0], found=found)
        scene, found = settled(own, trajectories[1:], scene, selection, options_)
    found = recover_lost(found, scene, capture, options_, context)
    save_registration(found, capture.cameras[0], files, rolling=read_summary(paths[0])["rolling"])
    if in_rig:
        write_dataclass(read_dataclass(RigPoses, paths[0], RIG_POSES), files, RIG_POSES)


RECOVER = Stage(
    function=_recover,
    libraries=(*VISION, "pycolmap"),
    modules=(*SEEING, "pycolmap"),
    memory_mb=_MEMORY_MB,
)
