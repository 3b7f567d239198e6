"""How certain a camera's path is."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodycap_batch.model.scene import Trajectory


def path_uncertainty(trajectory: Trajectory) -> dict[str, Any]:
    """Return the sigmas of a camera's poses and the extent of its path: root mean squares over its frames.

    Lengths are in the unit of the trajectory's frame. All values are None without a pose; a path of rotations
    alone has the sigma of the rotation.
    """
    posed = trajectory.registered
    variances = trajectory.covariance.diagonal(axis1=1, axis2=2)
    turned = posed if posed.any() else trajectory.rotation_only
    sigma_rad = np.sqrt(variances[turned, :3].sum(axis=1).mean()) if turned.any() else None
    out = {
        "sigma": None,
        "sigma_deg": None if sigma_rad is None else float(np.degrees(sigma_rad)),
        "extent": None,
    }
    if not posed.any():
        return out
    centres = trajectory.gauge_from_cam[posed, :3, 3]
    return out | {
        "sigma": float(np.sqrt(variances[posed, 3:].sum(axis=1).mean())),
        "extent": float(np.sqrt(((centres - centres.mean(axis=0)) ** 2).sum(axis=1).mean())),
    }
