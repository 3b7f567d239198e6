"""The task that uses the inertial sensor of a camera after its frames are registered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.capture import open_capture
from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.model.camera_clock import FrameTiming
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, FileRef
from bodycap_batch.tasks.loading import load_registration
from bodycap_batch.tasks.registered_cameras import INERTIAL_CAMERA
from bodycap_batch.tasks.registration import save_registration

if TYPE_CHECKING:
    from bodycap_batch.telemetry.streams import CameraTelemetry


@dataclass(frozen=True, slots=True, kw_only=True)
class InertialTask:
    """Use the inertial sensor of one camera.

    Attributes:
        options: Which uses of the telemetry are on.
        cameras: Names of the cameras with telemetry. The first one is the camera whose sensor is used; the
            others help to find the vertical and the scale of the map.
        capture: The videos of these cameras, in the same order.
        registrations: The registration of each camera, by name.
        samples: The files with inertial samples beside the videos, by name. A camera without a file has its
            samples in the video.
        stabilised: Whether the first camera stabilised its video; None if the job does not state it.
    """

    options: TelemetryOptions
    cameras: tuple[str, ...]
    capture: CaptureRef
    registrations: Mapping[str, ArtefactRef]
    samples: Mapping[str, FileRef]
    stabilised: bool | None = None


def run_inertial(task: InertialTask, context: StageContext, files: Path) -> None:
    """Use the sensor of the camera, and store the registration together with the result."""
    from bodycap_batch.inertial import use_sensor
    from bodycap_batch.telemetry import read_telemetry
    from bodycap_batch.telemetry.comparison import all_times_ns

    capture, configs = open_capture(task.capture.config, context.threads), task.capture.config.cameras
    camera = capture.cameras[0]
    times_ns = all_times_ns(camera, configs[0])
    try:
        telemetry = read_telemetry(camera.videos, times_ns, configs[0].samples)
    except CaptureError as error:
        telemetry = read_telemetry(camera.videos, times_ns)
        note = f"{error.one_line}; its samples are not used"
        telemetry = replace(telemetry, notes=(*telemetry.notes, note))
    before = task.registrations[camera.name].path
    registration = load_registration(before)

    def others() -> Iterator[tuple[Trajectory, CameraTelemetry]]:
        for other, config in zip(capture.cameras[1:], configs[1:], strict=True):
            context.check_cancelled()
            try:
                read = read_telemetry(other.videos, all_times_ns(other, config), config.samples)
            except CaptureError:  # the task of that camera reports it
                continue
            yield load_registration(task.registrations[other.name].path).trajectory, read

    stated = telemetry.with_statement(stabilised=task.stabilised)
    found = use_sensor(registration.trajectory, stated, task.options, others())
    notes = [f"{camera.name}: {note}" for note in telemetry.notes]
    if telemetry.gyro is not None and found.camera.relation is None:
        notes.append(f"{camera.name}: the inertial sensor is not used: {found.camera.reason}")
    turns = found.camera.turns
    if turns is not None and turns.says() != telemetry.stabilisation_note():  # the check said this already
        notes.append(f"{camera.name}: {turns.says()}")
    registration = replace(registration, trajectory=found.trajectory)
    camera = replace(camera, nominal_fps=read_dataclass(FrameTiming, before, "timing").nominal_fps)
    save_registration(registration, camera, files, notes=notes)
    write_dataclass(found.camera, files, INERTIAL_CAMERA)
