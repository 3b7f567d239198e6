"""The task of solving one camera's frames with the help of other cameras: rig and recover."""

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
        options: Options of registration.
        cameras: Names of the cameras: the task's own camera, then the others.
        capture: These cameras, in this order.
        keyframes: By camera.
        map: The map.
        registrations: By camera, in this order.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    cameras: tuple[str, ...]
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
