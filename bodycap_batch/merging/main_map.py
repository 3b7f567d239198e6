"""Choose the main map and its reference camera, and align the maps of all usable cameras to it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.provisional_scale import reach_constraint
from bodycap_batch.merging.map_alignment.align import UsableCameras, align_cameras
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import SkeletonModel

REFERENCE_ROLES = ("Spine1", "Spine", "Hips", "Neck", "Head")
"""Preferred bones for the reference camera, the best bone first: trunk, then neck and head.

Cameras on limbs are considered after the cameras on these bones, because limbs move relative to the trunk.
"""


_MIN_TIME_RATIO = 0.25
"""Minimum localised time of a good reference camera, as a fraction of the longest time of any camera.

A camera with a smaller fraction is considered after all cameras with a larger fraction. Evidence: none.
"""
_CLOCK_HINT = (
    "record sound, start all cameras and then clap once; or state `offset_s` of each camera; or, if one "
    "signal started all cameras, state `capture: {clocks: common}`"
)
"""Advice if only unknown clocks make the cameras unusable."""
_MAP_HINT = (
    "let two cameras on the trunk, on the head or on one limb film the same places, so that both cameras are "
    "in one map; film more texture, use more light, and start slowly; frames.csv lists why frames were lost"
)
"""Advice if no map holds enough cameras."""


def align_usable_cameras(
    inputs: MergeInputs,
    step: Callable[[], None],
    options: MergeOptions,
    excluded: Mapping[str, str],
) -> UsableCameras:
    """Select the main map, and align the maps of all usable cameras to the main map.

    The main map is the best candidate for which the cameras determine the scale.

    Args:
        inputs: Trajectories, skeleton, mounts and clocks.
        step: Function that is called after each iteration. It may raise an exception to stop the work.
        options: Options of the stage, with the known distance and the marker board of the job.
        excluded: By name of a camera that must not be used, the reason.

    Returns:
        The usable cameras, with trajectories in the gauge of the main map.

    Raises:
        EstimationError: No map contains two cameras whose distance is limited by the skeleton.
    """
    unused: dict[str, str] = {}
    for cameras, further in candidate_main_maps(inputs, excluded):
        aligned = align_cameras(inputs, cameras, further, step, options)
        roles = [inputs.mount_of(each.camera).role for each in aligned.trajectories]
        if _can_determine_scale(inputs.skeleton, roles):
            return replace(aligned, unused={**excluded, **aligned.unused})
        unused = unused or dict(aligned.unused)
    unused = {**excluded, **unused}
    usable = [each.camera for each in inputs.trajectories if each.camera not in unused]
    reasons = "; ".join(f"{camera!r}: {reason}" for camera, reason in sorted(unused.items()))
    unknown = [camera for camera in unused if not inputs.clocks[camera].is_known]
    raise EstimationError(
        "no two cameras determine the size of the body: the usable cameras are "
        f"{', '.join(map(repr, usable)) or 'none'}"
        + (f"; the unusable cameras are {reasons}" if reasons else ""),
        hint=_CLOCK_HINT if unknown and len(unknown) == len(unused) else _MAP_HINT,
    )


def candidate_main_maps(
    inputs: MergeInputs, excluded: Collection[str]
) -> list[tuple[list[Trajectory], list[Trajectory]]]:
    """Return all maps as candidates for the main map, the best candidate first.

    The rank of a map is the rank of its best reference camera. Cameras are ranked by their bone: first trunk,
    then head, then limbs. The number of localised frames decides between cameras with equally good bones.
    Cameras that were localised for a short time come after all other cameras.

    Args:
        inputs: Trajectories, mounts and clocks.
        excluded: Names of cameras that must not be used.

    Returns:
        For each map, the trajectories in this map, that of the reference camera first. Then the trajectories
        in all other maps, which may be aligned to this map.
    """
    counts = {each.camera: int(each.localised.sum()) for each in inputs.trajectories}
    seconds = {camera: count / inputs.clocks[camera].nominal_fps for camera, count in counts.items()}

    def rank(trajectory: Trajectory) -> tuple[bool, int, int]:
        camera, role = trajectory.camera, inputs.mount_of(trajectory.camera).role
        is_short = seconds[camera] < _MIN_TIME_RATIO * max(seconds.values())
        order = REFERENCE_ROLES.index(role) if role in REFERENCE_ROLES else len(REFERENCE_ROLES)
        return is_short, order, -counts[camera]

    ranked = sorted((each for each in inputs.trajectories if each.camera not in excluded), key=rank)
    return [
        ([each for each in ranked if each.gauge == gauge], [each for each in ranked if each.gauge != gauge])
        for gauge in dict.fromkeys(each.gauge for each in ranked)
    ]


def _can_determine_scale(skeleton: SkeletonModel, roles: Sequence[str]) -> bool:
    """Return True if the skeleton limits the distance between at least two cameras on these bones."""
    if len(roles) < 2:
        return False
    bones = kinematic_chain(skeleton, set(roles))
    index = {bone.role: number for number, bone in enumerate(bones)}
    return any(
        reach_constraint(bones, index[one], index[other]) is not None for one, other in permutations(roles, 2)
    )
