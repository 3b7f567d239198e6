"""The task that uses the inertial sensor of a camera after its frames are registered."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, FileRef
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.registered_cameras import INERTIAL_CAMERA, RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage, read_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialTask:
    """Use the inertial sensor of one camera.

    Attributes:
        options: Which uses of the telemetry are on.
        capture: The video of the camera.
        registration: The registration of the camera.
        samples: The file with inertial samples beside the video; None if the samples are in the video.
    """

    options: TelemetryOptions
    capture: CaptureRef
    registration: ArtefactRef
    samples: FileRef | None


def run_inertial(task: InertialTask, context: StageContext, files: Path) -> None:
    """Use the sensor of the camera, and store the registration together with the result."""
    from bodycap_batch.capture import open_capture
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.inertial import use_sensor
    from bodycap_batch.model.relative_pose import RigPoses
    from bodycap_batch.telemetry import read_telemetry
    from bodycap_batch.telemetry.comparison import all_times_ns

    context.check_cancelled()
    camera, config = (
        open_capture(task.capture.config, context.threads).cameras[0],
        task.capture.config.cameras[0],
    )
    telemetry = read_telemetry(camera.videos, all_times_ns(camera, config), camera.name)
    before = task.registration.path
    registration = load_registration(before)
    found = use_sensor(registration.trajectory, telemetry, task.options)
    notes = [f"{camera.name}: {note}" for note in telemetry.notes]
    if telemetry.gyro is not None and found.camera.relation is None:
        notes.append(f"{camera.name}: the inertial sensor is not used: {found.camera.reason}")
    registration = replace(registration, trajectory=found.trajectory)
    save_registration(registration, camera, files, rolling=read_summary(before)["rolling"], notes=notes)
    write_dataclass(found.camera, files, INERTIAL_CAMERA)
    if (before / f"{RIG_POSES}.json").exists():
        write_dataclass(read_dataclass(RigPoses, before, RIG_POSES), files, RIG_POSES)


INERTIAL = Stage(
    name="inertial",
    task=InertialTask,
    function=run_inertial,
    libraries=(*VISION_LIBRARIES, "scipy"),
    modules=(*VISION_MODULES, "bodycap_batch.inertial", "scipy.optimize", "scipy.interpolate"),
)
