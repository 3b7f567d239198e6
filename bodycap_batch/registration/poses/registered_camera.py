"""A camera together with its registration."""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import Registration
from bodycap_batch.registration.tracking.klt import Tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCamera:
    """A camera with its registration.

    Attributes:
        camera: The camera.
        registration: The registration of this camera.
        rotation: The rotation of a camera with a rolling shutter from matches between adjacent frames; None
            if it is unknown.
    """

    camera: CaptureCamera
    registration: Registration
    rotation: RotationPath | None = None

    @property
    def tracks(self) -> Tracks:
        """The tracked observations in the frames of this camera."""
        registration = self.registration
        return Tracks(
            registration.obs_frame, registration.obs_keyframe, registration.obs_feature, registration.obs_px
        )
