"""Which cameras make the body: whose map is the main one, which camera leads, and who is left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

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
from bodycap_batch.model.skeleton import Mount

MIN_LOCALISED_FRAMES = 15
"""Localised frames below which a camera tells nothing about a motion: half a second at 30 fps."""
REFERENCE_ROLES = ("Spine1", "Spine", "Hips", "Neck", "Head")
"""Bones whose camera can lead, the best first: limbs are judged against it."""
_MIN_TIME_RATIO = 0.25
"""Share of the longest camera's time below which a camera does not lead, nor its map become the main one."""


def select_cameras(
    inputs: MergeInputs, step: Callable[[], None], options: MergeOptions
) -> tuple[MergeInputs, UsableCameras]:
    """The inputs with priors that cameras at one place share, and the cameras that make the body.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Called after each iteration; may raise to stop.
        options: What the job states of the scale.

    Raises:
        EstimationError: No map holds two cameras whose distance the body knows.
    """
    useless = excluded_cameras(inputs)
    shared = correlate_mount_priors(inputs, useless)
    return shared, align_usable_cameras(shared, step, options, useless)


def align_usable_cameras(
    inputs: MergeInputs,
    step: Callable[[], None],
    options: MergeOptions | None = None,
    useless: Mapping[str, str] | None = None,
) -> UsableCameras:
    """Gather the cameras that can be used together, from the first main map that makes a body.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Called after each iteration; may raise to stop.
        options: What the job states of the scale.
        useless: What `excluded_cameras` says, where that is known.

    Raises:
        EstimationError: No map holds two cameras whose distance the body knows.
    """
    useless = excluded_cameras(inputs) if useless is None else useless
    left_out: dict[str, str] = {}
    for main, further in candidate_main_maps(inputs, useless):
        together = align_cameras(inputs, main, further, step, options)
        if _determine_scale(inputs, together.trajectories):
            return replace(together, unused={**useless, **together.unused})
        left_out = left_out or dict(together.unused)
    left_out = {**useless, **left_out}
    usable = [each.camera for each in inputs.trajectories if each.camera not in left_out]
    reasons = "; ".join(f"{camera!r}: {why}" for camera, why in sorted(left_out.items()))
    raise EstimationError(
        f"no two cameras tell how large the body is: {', '.join(map(repr, usable)) or 'none'} can be used"
        + (f"; {reasons}" if reasons else ""),
        hint="a skeleton needs one map with two cameras on trunk, head or the same limb; frames.csv has the "
        "reasons of lost frames, more texture, light or a slower start help",
    )


def correlate_mount_priors(inputs: MergeInputs, useless: Mapping[str, str] | None = None) -> MergeInputs:
    """Cameras that are expected at the same place by their names alone are off it together, as a rig is.

    Each alone would say where the body is as if the others had been strapped on by somebody else.
    """
    useless = excluded_cameras(inputs) if useless is None else useless
    paths = [each.camera for each in inputs.trajectories if each.camera not in useless]
    worn = [inputs.mount_of(camera) for camera in paths]

    def shared(mount: Mount) -> Mount:
        beside = sum(
            has_unknown_roll(other) and other.role == mount.role and _at_same_position(other, mount)
            for other in worn
            if other.camera != mount.camera
        )
        if not beside or not has_unknown_roll(mount):
            return mount
        factor = float(np.sqrt(1.0 + beside))
        return replace(mount, sigma_rad=factor * mount.sigma_rad, sigma_m=factor * mount.sigma_m)

    return replace(inputs, mounts=tuple(shared(mount) for mount in inputs.mounts))


def _at_same_position(first: Mount, second: Mount) -> bool:
    return bool(np.allclose(first.joint_from_cam[:3, 3], second.joint_from_cam[:3, 3]))


def excluded_cameras(inputs: MergeInputs) -> dict[str, str]:
    """By camera that tells nothing of the body's motion, why."""
    seldom = rarely_localised(inputs)
    still = stationary_cameras(inputs, [each for each in inputs.trajectories if each.camera not in seldom])
    why = "it stands still while the others move: nobody wears it, or it is frozen"
    return {**seldom, **dict.fromkeys(still, why)}


def rarely_localised(inputs: MergeInputs) -> dict[str, str]:
    """By camera that is of no use, why."""
    counts = {each.camera: int(each.localised.sum()) for each in inputs.trajectories}
    return {
        each.camera: f"{counts[each.camera]} localised frames of {len(each.status)}, {MIN_LOCALISED_FRAMES} needed"
        for each in inputs.trajectories
        if counts[each.camera] < MIN_LOCALISED_FRAMES
    }


def candidate_main_maps(
    inputs: MergeInputs, useless: Mapping[str, str] | None = None
) -> list[tuple[list[Trajectory], list[Trajectory]]]:
    """Each map as the main one, the best first: its cameras, the leading one first, and those of other maps.

    A trunk's camera leads before a head's, a head's before a limb's; one that was hardly localised leads
    after all others.
    """
    counts = {each.camera: int(each.localised.sum()) for each in inputs.trajectories}
    seconds = {camera: count / inputs.clocks[camera].nominal_fps for camera, count in counts.items()}

    def rank(trajectory: Trajectory) -> tuple[bool, int, int]:
        role, camera = inputs.mount_of(trajectory.camera).role, trajectory.camera
        short = seconds[camera] < _MIN_TIME_RATIO * max(seconds.values())
        return (
            short,
            REFERENCE_ROLES.index(role) if role in REFERENCE_ROLES else len(REFERENCE_ROLES),
            -counts[camera],
        )

    without = excluded_cameras(inputs) if useless is None else useless
    ranked = sorted((each for each in inputs.trajectories if each.camera not in without), key=rank)
    return [
        ([each for each in ranked if each.gauge == gauge], [each for each in ranked if each.gauge != gauge])
        for gauge in dict.fromkeys(each.gauge for each in ranked)
    ]


def _determine_scale(inputs: MergeInputs, used: Sequence[Trajectory]) -> bool:
    """Whether the body knows the distance of any two cameras."""
    roles = [inputs.mount_of(each.camera).role for each in used]
    if len(roles) < 2:
        return False
    bones = kinematic_chain(inputs.skeleton, set(roles))
    place = {bone.role: index for index, bone in enumerate(bones)}
    return any(
        reach_constraint(bones, place[one], place[other]) is not None
        for number, one in enumerate(roles)
        for index, other in enumerate(roles)
        if number != index
    )
