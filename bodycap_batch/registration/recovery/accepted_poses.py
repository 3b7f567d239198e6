"""Accept the poses of searched frames, and place them into a trajectory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bodycap_batch.model.geometry import invert
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.registration.recovery.guided_localisation import GuidedLocaliser, PoseEstimate
from bodycap_batch.registration.recovery.motion_prior import PositionEstimate

_MIN_INLIER_WEIGHT_RATIO = 0.5
"""Minimum inlier weight ratio of an accepted pose: the weight of the inliers divided by the weight of all
matches. Evidence: none."""


def accepted_pose(
    estimate: PoseEstimate, position: PositionEstimate, localiser: GuidedLocaliser, frame: int
) -> PoseEstimate | None:
    """Return the pose of a searched frame with its centre at another position; None if it is not accepted.

    A pose is accepted if it has enough support, and if the sigma of its centre is small. If the angular
    velocity of a camera with a rolling shutter is extrapolated in the frame, its error adds to the
    covariance.

    Args:
        estimate: The pose from the picture of the frame.
        position: The position of the camera from the pose and from the camera's motion together.
        localiser: The localiser that found the pose, with the conditions of a pose and the shutter.
        frame: Frame index.
    """
    criteria, shutter = localiser.criteria, localiser.shutter
    if not estimate.has_support(criteria.min_inliers, _MIN_INLIER_WEIGHT_RATIO):
        return None
    pose, covariance = estimate.conditioned_on_centre(position)
    unsure = 0.0 if shutter is None else shutter.uncertainty(frame)
    covariance = covariance + np.diag(np.repeat([unsure, unsure * estimate.depth], 3) ** 2)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    if sigma >= criteria.max_sigma_depth * estimate.depth:
        return None
    return replace(estimate, cam_from_map=pose, covariance=covariance)


def with_poses(path: Trajectory, poses: Mapping[int, PoseEstimate]) -> Trajectory:
    """Return a trajectory with additional poses, by frame. Their status is `FrameStatus.REGISTERED`."""
    matrices, covariance = path.gauge_from_cam.copy(), path.covariance.copy()
    status, inliers, error_px = list(path.status), path.inliers.copy(), path.error_px.copy()
    for frame, estimate in poses.items():
        matrices[frame], covariance[frame] = invert(estimate.cam_from_map), estimate.covariance
        status[frame], inliers[frame] = FrameStatus.REGISTERED, estimate.inliers
        error_px[frame] = estimate.error_px
    return replace(
        path,
        gauge_from_cam=matrices,
        covariance=covariance,
        status=tuple(status),
        inliers=inliers,
        error_px=error_px,
    )
