"""The intrinsics of one camera during mapping."""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.model.camera import Camera


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The intrinsics of one camera, and how far to trust them.

    Attributes:
        camera: Camera model and its parameters.
        calibrated: True if the intrinsics come from a calibration; False if they are an estimate.
    """

    camera: Camera
    calibrated: bool
