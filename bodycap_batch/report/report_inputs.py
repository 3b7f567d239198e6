"""The results that a report shows. The job may have finished, or an error may have stopped it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bodycap_batch.capture import Capture
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.scene import KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.model.skeleton import Mount


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInputs:
    """The results of a job. If an error stopped the job, the results of later stages are empty.

    Attributes:
        name: Name of the job.
        cameras: Names of the job's cameras, in the order of the job.
        maps: The maps, largest first, each in its own gauge.
        registrations: One registration for each registered camera, in the gauge of the camera's map.
        clocks: Clock of each registered camera, by camera name.
        reference_camera: Name of the camera to which clock offsets are relative; "" if no clock is known.
        selections: The keyframe selection of each camera.
        merge: The result of merging: the body in the world; None if there is no body.
        mounts: The mounts that were assumed before the body was solved.
        metrics: The content of ``metrics.json``; None if there are no metrics.
        capture: The opened videos; None if they cannot be opened.
        failure: The error that stopped the job: ``type``, ``message``, ``hint`` and the error's other fields;
            None if no error stopped the job.
        max_gap_s: Maximum time (seconds) between two measurements that the body's motion bridges
            (``merge.max_gap_s``).
        places_from_motion: Place of each camera whose place the run found from the motion, by camera name.
        files: Paths of the result files, relative to the folder of the page.
    """

    name: str
    cameras: tuple[str, ...] = ()
    maps: tuple[Map, ...] = ()
    registrations: tuple[Registration, ...] = ()
    clocks: Mapping[str, CameraClock] = field(default_factory=dict)
    reference_camera: str = ""
    selections: tuple[KeyframeSelection, ...] = ()
    merge: MergeResult | None = None
    mounts: tuple[Mount, ...] = ()
    metrics: Mapping[str, Any] | None = None
    capture: Capture | None = None
    failure: Mapping[str, Any] | None = None
    max_gap_s: float = 1.0
    places_from_motion: Mapping[str, str] = field(default_factory=dict)
    files: tuple[str, ...] = ()

    def registration(self, camera: str) -> Registration | None:
        """Return the registration of a camera, or None if the camera was not registered."""
        return next((found for found in self.registrations if found.trajectory.camera == camera), None)

    def selection(self, camera: str) -> KeyframeSelection | None:
        """Return the keyframe selection of a camera, or None if the camera has no selection."""
        return next((found for found in self.selections if found.camera == camera), None)

    def path(self, camera: str) -> Trajectory | None:
        """Return the trajectory of a camera, or None if the camera was not registered.

        The trajectory is in the world if merging placed the camera there. Otherwise it is in the gauge of the
        camera's map.
        """
        merged = () if self.merge is None else self.merge.trajectories
        registration = self.registration(camera)
        in_world = next((path for path in merged if path.camera == camera), None)
        return in_world if in_world is not None or registration is None else registration.trajectory
