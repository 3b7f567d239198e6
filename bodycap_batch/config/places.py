"""Places of cameras on the body that the command line gives, for videos whose names do not contain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.models import CameraConfig
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of
from bodycap_batch.core.errors import JobError


@dataclass(frozen=True, slots=True)
class Places:
    """Places on the body by the name of a camera or of its video, as the user writes them.

    Attributes:
        by_name: The place of each named camera.
        worn: The places of all cameras, if the run finds from the motion which camera was where; else empty.
    """

    by_name: Mapping[str, str] = field(default_factory=dict)
    worn: tuple[str, ...] = ()

    def place_of(self, name: str) -> str | None:
        """Return the place that is given for a camera or a video; None if none is given."""
        return next((place for given, place in self.by_name.items() if _is_same(given, name)), None)

    def is_known(self, name: str) -> bool:
        """Return True if the place of a video is given or found later, or if its name contains the place."""
        return bool(self.worn) or self.place_of(name) is not None or mount_of(name) is not None

    def mounted(self, camera: CameraConfig) -> CameraConfig:
        """Return a camera with the place that is given for it, or unchanged.

        Raises:
            JobError: The place is unknown.
        """
        place = self._place_of_camera(camera)
        if place is None:
            return camera
        if mount_of(place) is None:
            raise JobError(
                f"there is no place {place[:40]!r} on the body",
                field="--camera",
                hint=f"use one of {', '.join(MOUNT_NAMES)}",
            )
        return camera.model_copy(update={"mount": place, "mount_source": None, "segment": None})

    def require_used(self, cameras: Sequence[CameraConfig]) -> None:
        """Check that each name belongs to a camera. Raises `JobError`."""
        for name in self.by_name:
            if not any(Places({name: ""})._place_of_camera(camera) is not None for camera in cameras):
                raise JobError(
                    f"there is no camera {name[:40]!r}",
                    field="--camera",
                    hint=f"use one of these names: {', '.join(camera.name for camera in cameras)}",
                )

    def _place_of_camera(self, camera: CameraConfig) -> str | None:
        names = (camera.name, *(video.name for video in camera.video))
        return next((place for name in names if (place := self.place_of(name)) is not None), None)


def _is_same(given: str, name: str) -> bool:
    """Return True if two names are equal regardless of upper and lower case and of the suffix of a video."""
    return (
        given.lower() in (name.lower(), Path(name).stem.lower()) or Path(given).stem.lower() == name.lower()
    )
