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
    from bodycap_batch.model.relative_pose import RigPoses, loose_note
    from bodycap_batch.registration import RigCamera, register_in_rig

    context.check_cancelled()
    own, *others = (
        RigCamera(camera=camera, found=load_registration(path))
        for camera, path in zip(load_capture(arguments).cameras, arguments["registrations"], strict=True)
    )
    options_ = RegistrationOptions.model_validate(options)
    selection = load_keyframes(arguments["selection"])
    found, relative = register_in_rig(own, others, load_map(arguments["map"]).maps, selection, options_)
    notes = [loose_note(each) for each in relative if not each.rigid]
    save_registration(found, own.camera, files, rolling=False, notes=notes)
    write_dataclass(RigPoses(relative=tuple(relative)), files, RIG_POSES)


RIG = Stage(function=_rig, libraries=(*VISION, "pycolmap"), modules=(*SEEING, "pycolmap"))
