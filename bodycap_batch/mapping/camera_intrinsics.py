"""The intrinsics of one camera during mapping."""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.model.camera import Camera


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The intrinsics of one camera, and whether they come from a calibration.

    Attributes:
        camera: Camera model and its parameters.
        calibrated: True if the intrinsics come from a calibration; False if they are only a first estimate.
    """

    camera: Camera
    calibrated: bool
