"""The task that recovers the lost frames of a camera after the poses of its other frames are final."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.camera_group import CameraGroupTask
from bodycap_batch.tasks.inputs import paths_of
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage, read_summary

_MEMORY_MB = 900
"""Memory to reserve (MB) for a recovery task. Recovery holds a limited number of keyframes and frames in
memory, about half a megabyte for each image."""


def run_recover(task: CameraGroupTask, context: StageContext, files: Path) -> None:
    """Recover the lost frames of the task's first camera; store all poses of this camera."""
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.relative_pose import RigPoses
    from bodycap_batch.registration import (
        RecoveryInputs,
        recover_lost_frames,
        with_rotation,
    )

    context.check_cancelled()
    capture = load_capture(task.capture, task.keyframes, threads=context.threads)
    paths = paths_of(task.registrations.values())
    scene = load_map(task.map.path)
    in_rig = (paths[0] / f"{RIG_POSES}.json").exists()
    selections = {name: load_keyframes(item.path) for name, item in task.keyframes.items()}
    inputs = RecoveryInputs(
        capture=capture,
        # A generator loads one registration at a time: the tracks of a long video need much memory.
        registrations=(
            with_rotation(camera, load_registration(path), scene.maps, selections[camera.name])
            for camera, path in zip(capture.cameras, paths, strict=True)
        ),
        maps=scene.maps,
        selection=selections[task.cameras[0]],
        in_rig=in_rig,
        misplaced=scene.diagnostics.misplaced.get(task.cameras[0], ()),
    )
    registration = recover_lost_frames(load_registration(paths[0]), inputs, task.options, context)
    save_registration(registration, capture.cameras[0], files, rolling=read_summary(paths[0])["rolling"])
    if in_rig:
        write_dataclass(read_dataclass(RigPoses, paths[0], RIG_POSES), files, RIG_POSES)


RECOVER = Stage(
    name="recover",
    task=CameraGroupTask,
    function=run_recover,
    libraries=(*VISION_LIBRARIES, "pycolmap"),
    modules=(*VISION_MODULES, "pycolmap"),
    memory_mb=_MEMORY_MB,
)
