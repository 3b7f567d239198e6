"""Localise the lost frames of a camera in other maps than the map of its path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.scene import (
    FrameStatus,
    KeyframeSelection,
    Map,
    OtherPaths,
    Registration,
    Trajectory,
)
from bodycap_batch.registration.stage import register_frames


def localise_in_other_maps(
    found: Registration,
    camera: CaptureCamera,
    maps: Sequence[Map],
    selection: KeyframeSelection,
    options: RegistrationOptions,
    context: StageContext,
) -> tuple[Registration, OtherPaths]:
    """Localise the lost frames of one camera in all maps but the map of its path.

    Args:
        found: The camera's registration.
        camera: The camera.
        maps: All maps. A frame that several maps localise is in the first of them.
        selection: The keyframes of the camera.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        context: Threads, progress and cancellation.

    Returns:
        The registration, in which the frames that other maps localise have the status OTHER_MAP; their poses
        in the other maps.
    """
    lost = ~found.trajectory.localised
    status, paths = list(found.trajectory.status), list[Trajectory]()
    for scene in maps:
        if scene.gauge == found.trajectory.gauge or not len(scene.keyframes_of(camera.name)):
            continue
        path = register_frames(camera, [scene], selection, options, context).trajectory
        gained = path.localised & lost
        if gained.any():
            paths.append(path.without(~gained, FrameStatus.OTHER_MAP))
        lost &= ~gained
        status = [FrameStatus.OTHER_MAP if new else old for new, old in zip(gained, status, strict=True)]
    trajectory = replace(found.trajectory, status=tuple(status))
    return replace(found, trajectory=trajectory), OtherPaths(trajectories=tuple(paths))
