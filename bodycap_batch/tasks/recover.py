"""The task that looks for a camera's lost frames once more, when its poses are final."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, read_summary

_MEMORY_MB = 900
"""With as many keyframes and frames held as recovery allows, at half a megabyte each."""


def _recover(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.relative_pose import RigPoses
    from bodycap_batch.registration import RecoveryInputs, RegisteredCamera, recover_lost_frames

    context.check_cancelled()
    capture = load_capture(arguments, context.threads)
    paths = [Path(path) for path in arguments["registrations"]]
    in_rig = (paths[0] / f"{RIG_POSES}.json").exists()
    inputs = RecoveryInputs(
        capture=capture,
        # A generator loads one registration at a time: the tracks of a long video are most of an artefact.
        registrations=(
            RegisteredCamera(camera=camera, registration=load_registration(str(path)))
            for camera, path in zip(capture.cameras, paths, strict=True)
        ),
        maps=load_map(arguments["map"]).maps,
        selection=load_keyframes(arguments["selection"]),
        in_rig=in_rig,
    )
    registration = recover_lost_frames(
        load_registration(str(paths[0])), inputs, RegistrationOptions.model_validate(options), context
    )
    save_registration(registration, capture.cameras[0], files, rolling=read_summary(paths[0])["rolling"])
    if in_rig:
        write_dataclass(read_dataclass(RigPoses, paths[0], RIG_POSES), files, RIG_POSES)


RECOVER = Stage(
    function=_recover,
    libraries=(*VISION, "pycolmap"),
    modules=(*SEEING, "pycolmap"),
    memory_mb=_MEMORY_MB,
)
