"""The data that all steps of one mapping run share: workspace, camera intrinsics, mapper options."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE


@dataclass(frozen=True, slots=True, kw_only=True)
class MappingContext:
    """The data that all steps of one mapping run share. Each step gets this object as an argument.

    Attributes:
        workspace: Folder of the database.
        intrinsics: Intrinsics by camera name.
        mapper_options: Function that returns a new copy of the options of COLMAP's mapper. A caller may
            change its copy.
        calibrated_ids: Database ids of the calibrated cameras. The intrinsics of these cameras stay constant.
        stage: Threads, progress, cancellation.
        frame_numbers: `CaptureCamera.frame_numbers` of each camera, by camera name.
        skeletal_above: Maximum number of keyframes of a map that is not large (`is_large`).
        times_ns: Times of all frames of each camera, nanoseconds, by camera name.
        lens_sigma: By database id, the relative standard deviation of the focal length of those calibrated
            cameras whose lens was estimated from tracks. The last adjustment refines it.
    """

    workspace: Path
    intrinsics: Mapping[str, CameraIntrinsics]
    mapper_options: Callable[[], Any]
    calibrated_ids: Collection[int]
    stage: StageContext
    frame_numbers: Mapping[str, IntArray]
    skeletal_above: int = SKELETAL_ABOVE
    times_ns: Mapping[str, IntArray] = field(default_factory=dict)
    lens_sigma: Mapping[int, float] = field(default_factory=dict)

    @property
    def given_ids(self) -> frozenset[int]:
        """Database ids of the calibrated cameras whose lens was given."""
        return frozenset(self.calibrated_ids) - self.lens_sigma.keys()

    def is_large(self, keyframes: int) -> bool:
        """Return whether a map of `keyframes` keyframes is too large for repeated global adjustments.

        A large map is built from skeletal keyframes (the reduced set of keyframes, Snavely's skeletal set).
        If keyframes are added to a large map, only the new keyframes are adjusted.
        """
        return keyframes > self.skeletal_above and is_on(Mechanism.SKELETAL_SET)
