"""What the steps of a mapping run share: the workspace, camera intrinsics, settings."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingContext:
    """What a repair needs besides the map.

    Attributes:
        workspace: Folder of the database.
        lenses: Lens of each camera, and whether it is known.
        settings: Makes the mapper's settings.
        constant: Ids of calibrated cameras.
        context: Threads, progress, cancellation.
        frame_numbers: `CaptureCamera.frame_numbers` of each camera.
    """

    workspace: Path
    lenses: Mapping[str, tuple[Camera, bool]]
    settings: Callable[[], Any]
    constant: Collection[int]
    context: StageContext
    frame_numbers: Mapping[str, IntArray]
