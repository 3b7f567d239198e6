"""Wider mount priors for cameras of one rig, which share one error."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from bodycap_batch.merging.body_calibration.camera_roll import has_unknown_roll
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton import Mount


def correlate_mount_priors(inputs: MergeInputs, excluded: Collection[str]) -> MergeInputs:
    """Return the inputs with wider mount priors for cameras that share one nominal position.

    Cameras with the same nominal position form a rig and share one error. With independent priors, n such
    cameras would pull the body to the nominal position n times as strongly as one camera. The sigmas of each
    of these mount priors are therefore multiplied by √n. This function changes only mounts that are assumed
    from the cameras' names.

    Args:
        inputs: Trajectories and mounts.
        excluded: Names of cameras that are not used. They do not count.

    Returns:
        The inputs with the wider mount priors.
    """
    used = [inputs.mount_of(each.camera) for each in inputs.trajectories if each.camera not in excluded]

    def correlated(mount: Mount) -> Mount:
        others = sum(
            has_unknown_roll(other) and other.role == mount.role and _at_same_position(other, mount)
            for other in used
            if other.camera != mount.camera
        )
        if not others or not has_unknown_roll(mount):
            return mount
        factor = float(np.sqrt(1.0 + others))
        return replace(mount, sigma_rad=factor * mount.sigma_rad, sigma_m=factor * mount.sigma_m)

    return replace(inputs, mounts=tuple(correlated(mount) for mount in inputs.mounts))


def _at_same_position(first: Mount, second: Mount) -> bool:
    return bool(np.allclose(first.joint_from_cam[:3, 3], second.joint_from_cam[:3, 3]))
