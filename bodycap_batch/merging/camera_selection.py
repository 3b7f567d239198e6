"""Select the main map, the reference camera and the cameras that can be used with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import NamedTuple

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.provisional_scale import reach_constraint
from bodycap_batch.merging.body_calibration.camera_roll import has_unknown_roll
from bodycap_batch.merging.cameras.stationary import stationary_cameras
from bodycap_batch.merging.map_alignment.align import UsableCameras, align_cameras
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Mount, SkeletonModel

MIN_LOCALISED_FRAMES = 15
"""Minimum number of localised frames of a camera: half a second at 30 fps. Evidence: none."""
REFERENCE_ROLES = ("Spine1", "Spine", "Hips", "Neck", "Head")
"""Bones whose camera can be the reference camera, the best first. Limbs move relative to them."""
_MIN_TIME_RATIO = 0.25
"""Minimum localised time of the reference camera, as a part of that of the longest one. Evidence: none."""


class SelectedCameras(NamedTuple):
    """The cameras that the body is solved from.

    Attributes:
        inputs: The inputs with correlated mount priors.
        aligned: The usable cameras in the main map's gauge.
    """

    inputs: MergeInputs
    aligned: UsableCameras


class MainMapCandidate(NamedTuple):
    """A map that may become the main one.

    Attributes:
        cameras: Its cameras' trajectories, that of the reference camera first.
        further: The trajectories in other maps.
    """

    cameras: list[Trajectory]
    further: list[Trajectory]


def select_cameras(inputs: MergeInputs, step: Callable[[], None], options: MergeOptions) -> SelectedCameras:
    """Select the cameras to solve the body from, and correlate the mount priors at equal positions.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Called after each iteration; may raise to stop.
        options: What the job states of the scale.

    Raises:
        EstimationError: No map has two cameras at a distance that the body determines.
    """
    excluded = excluded_cameras(inputs)
    correlated = correlate_mount_priors(inputs, excluded)
    return SelectedCameras(correlated, align_usable_cameras(correlated, step, options, excluded))


def align_usable_cameras(
    inputs: MergeInputs,
    step: Callable[[], None],
    options: MergeOptions | None = None,
    excluded: Mapping[str, str] | None = None,
) -> UsableCameras:
    """Align the usable cameras to the first main map with which they determine the scale.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Called after each iteration; may raise to stop.
        options: What the job states of the scale.
        excluded: The result of `excluded_cameras`, if it is known.

    Raises:
        EstimationError: No map has two cameras at a distance that the body determines.
    """
    excluded = excluded_cameras(inputs) if excluded is None else excluded
    unused: dict[str, str] = {}
    for candidate in candidate_main_maps(inputs, excluded):
        aligned = align_cameras(inputs, candidate.cameras, candidate.further, step, options)
        roles = [inputs.mount_of(each.camera).role for each in aligned.trajectories]
        if _can_determine_scale(inputs.skeleton, roles):
            return replace(aligned, unused={**excluded, **aligned.unused})
        unused = unused or dict(aligned.unused)
    unused = {**excluded, **unused}
    usable = [each.camera for each in inputs.trajectories if each.camera not in unused]
    reasons = "; ".join(f"{camera!r}: {reason}" for camera, reason in sorted(unused.items()))
    raise EstimationError(
        f"no two cameras determine the size of the body: {', '.join(map(repr, usable)) or 'none'} can be used"
        + (f"; {reasons}" if reasons else ""),
        hint="a skeleton needs one map with two cameras on trunk, head or the same limb; frames.csv has the "
        "reasons of lost frames; more texture, more light or a slower start help",
    )


def correlate_mount_priors(inputs: MergeInputs, excluded: Mapping[str, str] | None = None) -> MergeInputs:
    """Return the inputs with wider mount priors for cameras that share one nominal position.

    Cameras with the same nominal position form a rig and share one error. With independent priors, n such
    cameras would pull the body to the nominal position n times as strongly as one. The sigmas of each are
    therefore multiplied by √n.

    Args:
        inputs: Trajectories and mounts.
        excluded: The result of `excluded_cameras`, if it is known.
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


def excluded_cameras(inputs: MergeInputs) -> dict[str, str]:
    """Return the cameras that carry no information about the body's motion, with the reason."""
    rare = rarely_localised(inputs.trajectories)
    still = stationary_cameras(inputs, [each for each in inputs.trajectories if each.camera not in rare])
    reason = "it stands still while the others move: nobody wears it, or it is frozen"
    return {**rare, **dict.fromkeys(still, reason)}


def rarely_localised(trajectories: Sequence[Trajectory]) -> dict[str, str]:
    """Return the cameras with fewer than `MIN_LOCALISED_FRAMES`, with the reason."""
    counts = {each.camera: int(each.localised.sum()) for each in trajectories}
    needed = f"{MIN_LOCALISED_FRAMES} needed"
    return {
        each.camera: f"{counts[each.camera]} localised frames of {len(each.status)}, {needed}"
        for each in trajectories
        if counts[each.camera] < MIN_LOCALISED_FRAMES
    }


def candidate_main_maps(
    inputs: MergeInputs, excluded: Mapping[str, str] | None = None
) -> list[MainMapCandidate]:
    """Return each map as the main one, the best first.

    Reference cameras are ranked by their bone: trunk, head, limb. A camera that was localised for a short
    time comes after all others.

    Args:
        inputs: Trajectories, mounts and clocks.
        excluded: The result of `excluded_cameras`, if it is known.
    """
    counts = {each.camera: int(each.localised.sum()) for each in inputs.trajectories}
    seconds = {camera: count / inputs.clocks[camera].nominal_fps for camera, count in counts.items()}
    excluded = excluded_cameras(inputs) if excluded is None else excluded

    def rank(trajectory: Trajectory) -> tuple[bool, int, int]:
        camera, role = trajectory.camera, inputs.mount_of(trajectory.camera).role
        is_short = seconds[camera] < _MIN_TIME_RATIO * max(seconds.values())
        order = REFERENCE_ROLES.index(role) if role in REFERENCE_ROLES else len(REFERENCE_ROLES)
        return is_short, order, -counts[camera]

    ranked = sorted((each for each in inputs.trajectories if each.camera not in excluded), key=rank)
    return [
        MainMapCandidate(
            [each for each in ranked if each.gauge == gauge], [each for each in ranked if each.gauge != gauge]
        )
        for gauge in dict.fromkeys(each.gauge for each in ranked)
    ]


def _can_determine_scale(skeleton: SkeletonModel, roles: Sequence[str]) -> bool:
    """Return True if the distance of any two cameras on these bones follows from the body."""
    if len(roles) < 2:
        return False
    bones = kinematic_chain(skeleton, set(roles))
    index = {bone.role: number for number, bone in enumerate(bones)}
    return any(
        reach_constraint(bones, index[one], index[other]) is not None for one, other in permutations(roles, 2)
    )
