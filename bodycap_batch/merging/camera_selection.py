"""Select the cameras that are used to solve the body, and widen the mount priors of cameras of one rig."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.merging.body_calibration.camera_roll import has_unknown_roll
from bodycap_batch.merging.cameras.excluded_cameras import excluded_cameras
from bodycap_batch.merging.main_map import align_usable_cameras
from bodycap_batch.merging.map_alignment.align import UsableCameras
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton import Mount


class SelectedCameras(NamedTuple):
    """The cameras that are used to solve the motion of the body.

    Attributes:
        inputs: The inputs, with wider mount priors for cameras of one rig (see `correlate_mount_priors`).
        aligned: The usable cameras, with trajectories in the gauge of the main map.
    """

    inputs: MergeInputs
    aligned: UsableCameras


def select_cameras(
    inputs: MergeInputs,
    step: Callable[[], None],
    options: MergeOptions,
    left_out: Mapping[str, str] | None = None,
) -> SelectedCameras:
    """Select the cameras that are used to solve the body.

    This function also widens the mount priors of cameras that share one nominal position.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Function that is called after each iteration. It may raise an exception to stop the work.
        options: Options of the stage, with the known distance and the marker board of the job.
        left_out: By name of a camera that must not be used, the reason.

    Returns:
        The selected cameras.

    Raises:
        EstimationError: No map contains two cameras whose distance is limited by the skeleton.
    """
    excluded = {**excluded_cameras(inputs), **(left_out or {})}
    correlated = correlate_mount_priors(inputs, excluded)
    return SelectedCameras(correlated, align_usable_cameras(correlated, step, options, excluded))


def correlate_mount_priors(inputs: MergeInputs, excluded: Mapping[str, str] | None = None) -> MergeInputs:
    """Return the inputs with wider mount priors for cameras that share one nominal position.

    Cameras with the same nominal position form a rig and share one error. With independent priors, n such
    cameras would pull the body to the nominal position n times as strongly as one camera. The sigmas of each
    of these mount priors are therefore multiplied by √n. This function changes only mounts that are assumed
    from the cameras' names.

    Args:
        inputs: Trajectories and mounts.
        excluded: The result of `excluded_cameras`; None to compute it.

    Returns:
        The inputs with the wider mount priors.
    """
    excluded = excluded_cameras(inputs) if excluded is None else excluded
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
