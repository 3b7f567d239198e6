"""The task that solves a camera's frames again with those of the others on its segment."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage


def _rig(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.model.relative_pose import RigPoses, not_rigid_note
    from bodycap_batch.registration import RegisteredCamera, register_in_rig

    context.check_cancelled()
    own, *others = (
        RegisteredCamera(camera=camera, registration=load_registration(path))
        for camera, path in zip(
            load_capture(arguments, context.threads).cameras, arguments["registrations"], strict=True
        )
    )
    options_ = RegistrationOptions.model_validate(options)
    selection = load_keyframes(arguments["selection"])
    maps = load_map(arguments["map"]).maps
    found, relative = register_in_rig(own, others, maps, selection, options_, context.threads)
    notes = [not_rigid_note(each) for each in relative if not each.is_rigid]
    save_registration(found, own.camera, files, rolling=False, notes=notes)
    write_dataclass(RigPoses(relative=tuple(relative)), files, RIG_POSES)


RIG = Stage(function=_rig, libraries=(*VISION, "pycolmap"), modules=(*SEEING, "pycolmap"))
