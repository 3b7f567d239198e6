"""Find the cameras that contain no information about the body's motion."""

from __future__ import annotations

from collections.abc import Sequence

from bodycap_batch.merging.cameras.stationary import stationary_cameras
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

MIN_LOCALISED_FRAMES = 15
"""Minimum number of localised frames of a camera: half a second at 30 fps. Evidence: none."""


def excluded_cameras(inputs: MergeInputs) -> dict[str, str]:
    """Find the cameras that contain no information about the body's motion.

    Args:
        inputs: Trajectories, mounts and clocks.

    Returns:
        By name of an excluded camera, the reason why the camera is excluded.
    """
    rare = rarely_localised(inputs.trajectories)
    unknown = {
        name: "; ".join(clock.notes) or "its clock is unknown"
        for name, clock in inputs.clocks.items()
        if not clock.is_known
    }
    rest = [each for each in inputs.trajectories if each.camera not in {*rare, *unknown}]
    still = stationary_cameras(inputs, rest)
    reason = (
        "this camera stands still while the other cameras move: nobody wears this camera, or its video is "
        "frozen"
    )
    return {**unknown, **rare, **dict.fromkeys(still, reason)}


def rarely_localised(trajectories: Sequence[Trajectory]) -> dict[str, str]:
    """Find the cameras with fewer localised frames than `MIN_LOCALISED_FRAMES`.

    Args:
        trajectories: The trajectories of all cameras.

    Returns:
        By name of an excluded camera, the reason why the camera is excluded.
    """
    counts = {each.camera: int(each.localised.sum()) for each in trajectories}
    needed = f"but {MIN_LOCALISED_FRAMES} are needed"
    return {
        each.camera: f"only {counts[each.camera]} of {len(each.status)} frames were localised, {needed}"
        for each in trajectories
        if counts[each.camera] < MIN_LOCALISED_FRAMES
    }
