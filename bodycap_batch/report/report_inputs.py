"""The results that a report shows, of a finished job or of one that stopped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from bodycap_batch.capture import Capture
from bodycap_batch.model.merge_data import CameraClock, MergeResult
from bodycap_batch.model.scene import KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.model.skeleton import Mount


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportInputs:
    """The results of a job. If the job stopped, the results of later stages are empty.

    Attributes:
        name: The job's name.
        cameras: Names of the job's cameras, in its order.
        maps: The maps, largest first, each in its own gauge.
        registrations: One for each camera, in the gauge of its map.
        clocks: Clock of each registered camera, by camera name.
        selections: Keyframe selections.
        merge: The body in the world.
        mounts: The mounts that were assumed before the body was solved.
        metrics: The content of ``metrics.json``.
        capture: The videos; None if they cannot be opened.
        failure: The error that stopped the job: ``type``, ``message``, ``hint`` and its other fields.
        max_gap_s: Longest time between two measurements that the body's motion bridges (``merge.max_gap_s``).
    """

    name: str
    cameras: tuple[str, ...] = ()
    maps: tuple[Map, ...] = ()
    registrations: tuple[Registration, ...] = ()
    clocks: Mapping[str, CameraClock] = field(default_factory=dict)
    selections: tuple[KeyframeSelection, ...] = ()
    merge: MergeResult | None = None
    mounts: tuple[Mount, ...] = ()
    metrics: Mapping[str, Any] | None = None
    capture: Capture | None = None
    failure: Mapping[str, Any] | None = None
    max_gap_s: float = 1.0

    def registration(self, camera: str) -> Registration | None:
        """Return a camera's registration, or None if it was not registered."""
        return next((found for found in self.registrations if found.trajectory.camera == camera), None)

    def selection(self, camera: str) -> KeyframeSelection | None:
        """Return a camera's keyframe selection, or None if there is none."""
        return next((found for found in self.selections if found.camera == camera), None)

    def path(self, camera: str) -> Trajectory | None:
        """Return a camera's poses: in the world if merging placed the camera, else in its map's gauge."""
        merged = () if self.merge is None else self.merge.trajectories
        registration = self.registration(camera)
        in_world = next((path for path in merged if path.camera == camera), None)
        return in_world if in_world is not None or registration is None else registration.trajectory
