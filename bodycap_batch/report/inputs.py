"""What a report is made of: whatever a job left behind, whole or broken off."""

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
    """Results of a job as far as it came; what is missing is left empty.

    Attributes:
        name: The job's name.
        cameras: Names of the job's cameras, in its order.
        maps: The models, largest first, each in its own gauge.
        registrations: One per camera, in the gauge of the map it was solved in.
        clocks: By camera name; of every registered camera.
        selections: Keyframe selections.
        merge: The body in the world.
        mounts: The mounts as they were assumed before the body was solved.
        metrics: The content of ``metrics.json``.
        capture: The videos; None where they cannot be opened.
        failure: What stopped the job: ``type``, ``message``, ``hint`` and more, as the error tells them.
        max_gap_s: Holes between two measurements up to this long were bridged (``merge.max_gap_s``).
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
        """One camera's frames, None where registration did not come that far."""
        return next((each for each in self.registrations if each.trajectory.camera == camera), None)

    def selection(self, camera: str) -> KeyframeSelection | None:
        """One camera's keyframes."""
        return next((each for each in self.selections if each.camera == camera), None)

    def path(self, camera: str) -> Trajectory | None:
        """One camera's poses: in the world where merging placed them, else in its map's gauge."""
        merged = () if self.merge is None else self.merge.trajectories
        found = self.registration(camera)
        placed = next((each for each in merged if each.camera == camera), None)
        return placed if placed is not None or found is None else found.trajectory
