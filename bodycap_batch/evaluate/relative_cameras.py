"""Compare the relative position of two cameras with the truth. Compare pose errors with their covariances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.association import interpolate_truth
from bodycap_batch.evaluate.trajectories import ErrorSummary
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import align_points, invert


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeCameraError:
    """The result of comparing the vector from the reference camera to another camera with the true vector.

    Attributes:
        frames: Number of frames in which both cameras have an estimated pose and a true pose.
        vector_m: Error (metres) of the vector between the camera centres in the world, after one rigid
            alignment of both trajectories with the truth.
        in_reference_m: Error (metres) of the vector between the camera centres in the coordinates of the
            reference camera, without alignment.
    """

    frames: int
    vector_m: ErrorSummary
    in_reference_m: ErrorSummary

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as plain JSON values."""
        return asdict(self)


def relative_camera_error(
    estimates: Mapping[str, TimedPoses],
    truths: Mapping[str, TimedPoses],
    camera: str,
    reference: str,
) -> RelativeCameraError:
    """Compare the vector between two cameras with the true vector, without an estimation of the scale.

    Args:
        estimates: Estimated poses world_from_camera (metres) at common times, by camera name.
        truths: True poses world_from_camera (metres) at common times, by camera name.
        camera: Name of the camera on the limb.
        reference: Name of the camera on the trunk.

    Raises:
        JobError: A camera is missing, or fewer than three frames have an estimated pose and a true pose of
            both cameras.
    """
    for name in (camera, reference):
        if name not in estimates or name not in truths:
            raise JobError(
                f"camera {name!r} has no estimated path or no true path",
                hint="give a camera that both folders contain",
            )
    times = estimates[camera].times_ns
    columns = [
        (estimates[camera].world_from_cam, np.ones(len(times), dtype=bool)),
        interpolate_truth(estimates[reference], times),
        interpolate_truth(truths[camera], times),
        interpolate_truth(truths[reference], times),
    ]
    found = np.logical_and.reduce([mask for _, mask in columns])
    if found.sum() < 3:
        hint = "check that all files use the same clock"
        raise JobError(f"only {found.sum()} frames have estimated and true poses of both cameras", hint=hint)
    limb, trunk, true_limb, true_trunk = (poses[found] for poses, _ in columns)
    centres = np.concatenate([limb[:, :3, 3], trunk[:, :3, 3]])
    alignment = align_points(
        centres, np.concatenate([true_limb[:, :3, 3], true_trunk[:, :3, 3]]), with_scale=False
    )
    vector = (limb[:, :3, 3] - trunk[:, :3, 3]) @ alignment.rotation.T
    true_vector = true_limb[:, :3, 3] - true_trunk[:, :3, 3]
    in_reference = (invert(trunk) @ limb)[:, :3, 3] - (invert(true_trunk) @ true_limb)[:, :3, 3]
    return RelativeCameraError(
        frames=int(found.sum()),
        vector_m=ErrorSummary.of(np.linalg.norm(vector - true_vector, axis=1)),
        in_reference_m=ErrorSummary.of(np.linalg.norm(in_reference, axis=1)),
    )
