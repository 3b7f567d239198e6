"""What is known of one camera before its keyframes are mapped."""

from __future__ import annotations

from dataclasses import dataclass, field

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.rotation_chain import RotationChain


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """The intrinsics of one camera, whether they come from a calibration, and how the camera turns.

    Attributes:
        camera: Camera model and its parameters.
        calibrated: True if the intrinsics come from a calibration; False if they are only a first estimate.
        rotation_chain: How the camera turns, by the tracks of its video; None if it is unknown.
        times_ns: (N,) times of its frames, nanoseconds; None if they are unknown.
    """

    camera: Camera
    calibrated: bool
    rotation_chain: RotationChain | None = field(default=None, compare=False)
    times_ns: IntArray | None = field(default=None, compare=False)
