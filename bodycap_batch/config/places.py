"""Places of cameras on the body that the command line gives, for videos whose names do not contain them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.models import CameraConfig
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of
from bodycap_batch.config.origins import Source
from bodycap_batch.core.errors import JobError


@dataclass(frozen=True, slots=True)
class Places:
    """Places on the body by the name of a camera or of its video, as the user writes them.

    Attributes:
        by_name: The place of each named camera.
        worn: The places of all cameras, if the run finds from the motion which camera was where; else empty.
        last: The place of each named camera in the last run, for cameras whose place the job does not give.
    """

    by_name: Mapping[str, str] = field(default_factory=dict)
    worn: tuple[str, ...] = ()
    last: Mapping[str, str] = field(default_factory=dict)

    def place_of(self, name: str) -> str | None:
        """Return the place that is given for a camera or a video; None if none is given."""
        return _place_of((name,), self.by_name) or _place_of((name,), self.last)

    def given_to(self, camera: CameraConfig) -> tuple[str, Source] | None:
        """Return the place that is given for a camera, and where it comes from; None if none is given."""
        names = (camera.name, *(video.name for video in camera.video))
        if (place := _place_of(names, self.by_name)) is not None:
            return place, "command line"
        is_stated = camera.mount is not None or camera.segment is not None
        place = None if is_stated else _place_of(names, self.last)
        return None if place is None else (place, "last run")

    def is_known(self, name: str) -> bool:
        """Return True if the place of a video is given or found later, or if its name contains the place."""
        return bool(self.worn) or self.place_of(name) is not None or mount_of(name) is not None

    def mounted(self, camera: CameraConfig) -> CameraConfig:
        """Return a camera with the place that is given for it, or unchanged.

        Raises:
            JobError: The place is unknown.
        """
        given = self.given_to(camera)
        if given is None:
            return camera
        place, _ = given
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
            if not any(Places({name: ""}).given_to(camera) is not None for camera in cameras):
                raise JobError(
                    f"there is no camera {name[:40]!r}",
                    field="--camera",
                    hint=f"use one of these names: {', '.join(camera.name for camera in cameras)}",
                )


def _place_of(names: Sequence[str], by_name: Mapping[str, str]) -> str | None:
    """Return the place that is given for one of the names of a camera; None if none is given."""
    found = (place for name in names for given, place in by_name.items() if _is_same(given, name))
    return next(found, None)


def _is_same(given: str, name: str) -> bool:
    """Return True if two names are equal regardless of upper and lower case and of the suffix of a video."""
    return (
        given.lower() in (name.lower(), Path(name).stem.lower()) or Path(given).stem.lower() == name.lower()
    )
