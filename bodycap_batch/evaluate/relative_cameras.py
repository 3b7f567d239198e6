"""One camera against another on the same body, and whether covariances mean what they say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.trajectories import ErrorSummary, TrajectoryOptions, truth_at
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import align_points, invert, so3_log


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeCameraError:
    """How well the vector from one camera to another is known, in metres.

    Attributes:
        frames: Frames where both cameras have a pose and a truth.
        vector_m: Error of the vector between the centres, the world turned by one rigid alignment of
            both trajectories.
        in_reference_m: Error of the camera's centre in the reference camera's own frame, no alignment.
    """

    frames: int
    vector_m: ErrorSummary
    in_reference_m: ErrorSummary

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)


def relative_camera_error(
    estimates: Mapping[str, TimedPoses],
    truths: Mapping[str, TimedPoses],
    camera: str,
    reference: str,
    options: TrajectoryOptions | None = None,
) -> RelativeCameraError:
    """Compare the vector between two cameras with the truth. Scale is not touched: estimates are metric.

    Args:
        estimates: world_from_camera by camera name, metres, on the common clock.
        truths: The same, true.
        camera: The camera on the limb.
        reference: The camera on the trunk.
        options: Only the association is used.

    Raises:
        JobError: A camera is missing, or fewer than 3 frames have all four poses.
    """
    options = options or TrajectoryOptions()
    for name in (camera, reference):
        if name not in estimates or name not in truths:
            raise JobError(
                f"camera {name!r} has no estimate or no truth", hint="name a camera that both folders hold"
            )
    times = estimates[camera].times_ns
    columns = [
        (estimates[camera].world_from_cam, np.ones(len(times), dtype=bool)),
        truth_at(estimates[reference], times, options),
        truth_at(truths[camera], times, options),
        truth_at(truths[reference], times, options),
    ]
    found = np.logical_and.reduce([there for _, there in columns])
    if found.sum() < 3:
        hint = "check that all files use the same clock"
        raise JobError(f"{found.sum()} frames have both cameras and their truth", hint=hint)
    limb, trunk, true_limb, true_trunk = (poses[found] for poses, _ in columns)
    centres = np.concatenate([limb[:, :3, 3], trunk[:, :3, 3]])
    alignment = align_points(
        centres, np.concatenate([true_limb[:, :3, 3], true_trunk[:, :3, 3]]), with_scale=False
    )
    vector = (limb[:, :3, 3] - trunk[:, :3, 3]) @ alignment.rotation.T
    true_vector = true_limb[:, :3, 3] - true_trunk[:, :3, 3]
    inside = (invert(trunk) @ limb)[:, :3, 3] - (invert(true_trunk) @ true_limb)[:, :3, 3]
    return RelativeCameraError(
        frames=int(found.sum()),
        vector_m=ErrorSummary.of(np.linalg.norm(vector - true_vector, axis=1)),
        in_reference_m=ErrorSummary.of(np.linalg.norm(inside, axis=1)),
    )


def normalised_errors(
    gauge_from_cam: FloatArray, covariance: FloatArray, true_gauge_from_cam: FloatArray
) -> FloatArray:
    """Squared pose errors in units of their covariance (N,): mean 6 where the covariance is right.

    Args:
        gauge_from_cam: (N,4,4) estimates.
        covariance: (N,6,6) rotation (rad) first, then translation, right perturbation.
        true_gauge_from_cam: (N,4,4) the truth in the same gauge.

    Source: Y. Bar-Shalom et al., "Estimation with Applications to Tracking and Navigation", 2001, 5.4
        (normalised estimation error squared).
    """
    difference = invert(gauge_from_cam) @ true_gauge_from_cam
    error = np.concatenate([so3_log(difference[:, :3, :3]), difference[:, :3, 3]], axis=1)
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray((error * solved).sum(axis=1))
