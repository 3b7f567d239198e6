"""The task that solves a camera's frames together with the other cameras on the same body segment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.camera_group import CameraGroupTask
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage


def run_rig(task: CameraGroupTask, context: StageContext, files: Path) -> None:
    """Solve the frames of the task's first camera from the observations of all cameras of the rig.

    The artefact holds the camera's poses and the relative poses of the rig's cameras.
    """
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.model.camera_clock import ClockRelation
    from bodycap_batch.model.relative_pose import RigPoses, not_rigid_note
    from bodycap_batch.registration import (
        register_in_rig,
        with_rotation,
        withdraw_contradicted_poses,
    )

    context.check_cancelled()
    scene = load_map(task.map.path)
    selections = {name: load_keyframes(item.path) for name, item in task.keyframes.items()}
    own, *others = (
        with_rotation(
            replace(camera, clock=ClockRelation(offset_s=task.offsets_s[camera.name])),
            load_registration(task.registrations[camera.name].path),
            scene.maps,
            selections[camera.name],
        )
        for camera in load_capture(task.capture, task.keyframes, threads=context.threads).cameras
    )
    selection = selections[own.camera.name]
    found, relative = register_in_rig(own, others, scene.maps, selection, task.options, context.threads)
    misplaced = scene.diagnostics.misplaced.get(own.camera.name, ())
    found = withdraw_contradicted_poses(found, scene.maps, misplaced)
    notes = [not_rigid_note(each) for each in relative if not each.is_rigid]
    save_registration(found, own.camera, files, rolling=False, notes=notes)
    write_dataclass(RigPoses(relative=tuple(relative)), files, RIG_POSES)


RIG = Stage(
    name="rig",
    task=CameraGroupTask,
    function=run_rig,
    libraries=(*VISION_LIBRARIES, "pycolmap"),
    modules=(*VISION_MODULES, "pycolmap"),
)
