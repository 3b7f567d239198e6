"""Prepare the recovery: remove misregistered keyframes and weak poses, and refine the map points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.config import RegistrationOptions
from bodycap_batch.config.lost_frames import LEAST_POSED
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.model.scene import KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration.poses.misplaced_keyframes import (
    find_misplaced_keyframes,
    map_without_keyframes,
)
from bodycap_batch.registration.poses.registered_camera import RegisteredCamera
from bodycap_batch.registration.poses.trajectory import (
    acceptance_criteria,
    build_trajectory,
    solve_camera,
)
from bodycap_batch.registration.poses.turning_tracks import turn_tracks
from bodycap_batch.registration.recovery.motion_prior import MotionStatistics, times_in_intervals
from bodycap_batch.registration.recovery.point_refinement import refine_points, remove_weak_boundary_poses


def remove_misplaced_keyframes(
    scene_map: Map,
    cameras: Iterable[RegisteredCamera],
    selection: KeyframeSelection,
    options: RegistrationOptions,
) -> Map:
    """Return the map without misregistered keyframes: keyframes that contradict the tracks of their camera.

    Args:
        scene_map: The map.
        cameras: Cameras with their registrations. Cameras that were registered against another map are
            ignored.
        selection: The keyframes of one camera. Only the noise of its tracks is used.
        options: Minimum number of inliers and maximum relative sigma of a pose.
    """
    misplaced: list[IntArray] = []
    for camera in cameras:
        if camera.registration.trajectory.gauge == scene_map.gauge:
            criteria = acceptance_criteria(camera.camera, selection, options)
            name = camera.camera.name
            turned = turn_tracks(name, scene_map, camera.tracks, camera.rotation)
            misplaced.append(find_misplaced_keyframes(name, scene_map, turned, criteria))
    return map_without_keyframes(scene_map, np.concatenate([np.zeros(0, np.int64), *misplaced]))


def prepare_recovery(
    own: RegisteredCamera,
    others: Sequence[Trajectory],
    scene_map: Map,
    selection: KeyframeSelection,
    options: RegistrationOptions,
    threads: int = 1,
) -> tuple[Map, Registration]:
    """Remove weak poses next to lost intervals, refine the map points and solve the camera's frames again.

    Weak poses are removed from all cameras. The map points are refined with the remaining poses.

    Args:
        own: The camera to recover, with its registration.
        others: Trajectories of the other cameras.
        scene_map: The map.
        selection: The keyframes of the camera.
        options: Minimum number of inliers and maximum relative sigma of a pose.
        threads: Number of threads that solve frames. The result does not depend on it.

    Returns:
        The map in the same gauge, and the registration. The map and the registration are unchanged in two
        cases. First, if no pose is removed: refined points then bring no gain. Second, if the remaining poses
        do not permit a recovery. Evidence: docs/decisions/registration.md.
    """
    if not is_on(Mechanism.POINT_REFINEMENT):
        return scene_map, own.registration
    before = [own.registration.trajectory, *(path for path in others if path.gauge == scene_map.gauge)]
    paths = [remove_weak_boundary_poses(path, options.min_inliers) for path in before]
    none_removed = all(path is unchanged for path, unchanged in zip(paths, before, strict=True))
    if none_removed or motion_statistics(paths[0]) is None:
        return scene_map, own.registration
    refined_map = refine_points(scene_map, paths)
    criteria = acceptance_criteria(own.camera, selection, options)
    poses = solve_camera(own.camera, refined_map, own.tracks, criteria, threads, own.rotation)
    path = build_trajectory(own.camera, scene_map.gauge, poses, selection)
    path = remove_weak_boundary_poses(path, options.min_inliers)
    if motion_statistics(path) is None:
        return scene_map, own.registration
    record_act(Mechanism.POINT_REFINEMENT)
    return refined_map, replace(own.registration, trajectory=path)


def motion_statistics(path: Trajectory) -> MotionStatistics | None:
    """Estimate how smoothly a camera moves.

    Returns:
        The statistics; None if recovery is not possible. This is the case if no frame is lost, if too few
        frames have a pose, or if the motion cannot be estimated from them.
    """
    has_pose = path.localised
    if has_pose.all() or has_pose.sum() < LEAST_POSED:
        return None
    return MotionStatistics.estimate(times_in_intervals(path.times_ns), path.gauge_from_cam[:, :3, 3])
