"""The task of the stages `rig` and `recover`: solve one camera's frames with the help of other cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bodycap_batch.config.options import RegistrationOptions
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.registration import NOT_ROUNDS


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraGroupTask:
    """Solve frames of one camera with the help of other cameras.

    Attributes:
        options: Options of the stage `registration`.
        cameras: Names of the cameras. The first camera is the one to solve; the other cameras help.
        capture: The videos of these cameras, in the order of `cameras`.
        keyframes: The selected keyframes of each camera, by camera name.
        map: The map.
        registrations: The registration of each camera, by camera name, in the order of `cameras`.
        offsets_s: Stated clock offset of each camera that shares a trigger, seconds, by camera name. Empty if
            the cameras share no trigger.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    cameras: tuple[str, ...]
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
    offsets_s: Mapping[str, float]
