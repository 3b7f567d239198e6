"""Recommend changes for the next capture. Each recommendation follows from a measurement of this job."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.scene import Map
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.grades import Advice
from bodycap_batch.report.readings import ADVICE_SEPARATOR, as_sentence
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.verdict import Verdict

MAX_RECOMMENDATIONS = 3
"""Maximum number of recommendations. Nobody changes more at once, and the next capture tells what remains.
Evidence: none."""
_FORWARD_DEG = 25.0
"""Maximum angle (degrees) between a camera's direction of motion and its optical axis.

At a smaller angle the camera is treated as moving along its line of sight. Evidence: none.
"""
_MAX_FORWARD_SHARE = 0.6
"""Maximum fraction of a camera's path on which the camera may move along its line of sight.

If every camera exceeds this fraction, depth is poorly known. Evidence: none.
"""
_MIN_SHARED_SHARE = 0.03
"""Minimum fraction of a camera's points that one other camera should also see.

If every other camera sees a smaller fraction, a recommendation is given. Evidence: none.
"""
_NARROW_DEG = 3.0
"""Minimum median triangulation angle, degrees. With a smaller angle, depth is poorly known. Evidence:
none."""
_MAX_GAP_S = 0.6
"""Maximum time (seconds) without a measurement at the start or the end of the motion that needs no advice: in
a longer time a whole swing of an arm can be missing."""
_T_POSE = re.compile(r",? or stand in a T-pose for two seconds first")
"""Pattern of the phrase about a T-pose in the advice that merging gives."""


def recommend_changes(inputs: ReportInputs, verdict: Verdict) -> list[Advice]:
    """Return at most three recommendations for the next capture, the most helpful recommendation first.

    Args:
        inputs: The results of the job.
        verdict: The verdict about these results.
    """
    coverage = verdict.coverage
    found = [
        *(() if coverage is None else coverage.advice),
        *(each.advice for each in verdict.criteria if each.advice is not None),
        *_about_overlap(inputs),
        *_about_parallax(inputs),
        *_about_start_and_end(inputs),
        *_about_hinges(inputs),
    ]
    # Criteria with the same remedy give it once, with the first reason.
    first = {each.action: each for each in reversed(found)}
    ordered = sorted(_combine_t_poses(list(first.values())), key=lambda advice: -advice.priority)
    return ordered[:MAX_RECOMMENDATIONS]


def _combine_t_poses(found: Sequence[Advice]) -> list[Advice]:
    """Combine several recommendations of a T-pose into a single recommendation.

    The phrase about the T-pose is removed from the original recommendations, and one recommendation of a
    T-pose is added. The added recommendation has a higher priority than the original recommendations.
    """
    improved = [recommendation for recommendation in found if _T_POSE.search(recommendation.action)]
    if len(improved) < 2:
        return list(found)
    others = [
        replace(recommendation, action=_T_POSE.sub("", recommendation.action))
        if recommendation in improved
        else recommendation
        for recommendation in found
    ]
    combined = Advice(
        action="Stand still for two seconds before you start, with the arms stretched out to the sides (a "
        "T-pose). This reduces the uncertainty of the mounts and of the scale.",
        reason="no T-pose was found, and sizes or the directions of cameras on their bones are not well "
        "known",
        priority=max(recommendation.priority for recommendation in improved) + 1e-3,
    )
    return [*others, combined]


def count_shared_points(maps: tuple[Map, ...], cameras: tuple[str, ...]) -> IntArray:
    """Count the map points that each pair of cameras sees.

    Args:
        maps: The maps.
        cameras: Names of the C cameras.

    Returns:
        (C,C) number of points that both cameras see. The diagonal holds the number of points of each camera.
    """
    shared = np.zeros((len(cameras), len(cameras)), dtype=np.int64)
    number = {name: index for index, name in enumerate(cameras)}
    for scene in maps:
        camera_of_keyframe = np.array(
            [number.get(name, -1) for name in scene.keyframe_camera], dtype=np.int64
        )
        seen = np.zeros((len(scene.points), len(cameras)), dtype=np.int64)
        camera_of_observation = camera_of_keyframe[scene.obs_keyframe]
        known = camera_of_observation >= 0
        seen[scene.obs_point[known], camera_of_observation[known]] = 1
        shared += seen.T @ seen
    return shared


def _about_overlap(inputs: ReportInputs) -> Iterator[Advice]:
    """Recommend to film common places with each camera that shares few points with any other camera."""
    if len(inputs.cameras) < 2 or not inputs.maps:
        return
    shared = count_shared_points(inputs.maps, inputs.cameras)
    for index, name in enumerate(inputs.cameras):
        own = int(shared[index, index])
        best = int(np.delete(shared[index], index).max(initial=0))
        if own and best < _MIN_SHARED_SHARE * own:
            yield Advice(
                action=f"Let {name} see the same places as the other cameras: hold this camera forward for "
                "a few steps, and walk past the same places twice.",
                reason=f"no other camera sees more than {best:,} of the {own:,} points that {name} sees",
                priority=1.5,
            )


def _about_parallax(inputs: ReportInputs) -> Iterator[Advice]:
    """Recommend sideways movement if all cameras moved mainly forward or triangulation angles are small."""
    forward_shares = []
    for registration in inputs.registrations:
        poses = registration.trajectory.gauge_from_cam[registration.trajectory.localised]
        # A fortieth of the path is long enough to give a direction despite the noise of single poses.
        stride = max(1, len(poses) // 40)
        step = poses[stride::stride, :3, 3] - poses[:-stride:stride, :3, 3][: len(poses[stride::stride])]
        length = np.linalg.norm(step, axis=1)
        axis = poses[:-stride:stride, :3, 2][: len(step)]
        cosine = np.abs((step * axis).sum(axis=1)) / np.maximum(length, 1e-12)
        moving = length > 0.2 * np.median(length) if len(length) else np.zeros(0, dtype=bool)
        if moving.sum() >= 5:
            forward_shares.append(float((cosine[moving] > np.cos(np.radians(_FORWARD_DEG))).mean()))
    angle_deg = _median_triangulation_deg(inputs.maps[0]) if inputs.maps else None
    only_forward = bool(forward_shares) and min(forward_shares) > _MAX_FORWARD_SHARE
    if only_forward or (angle_deg is not None and angle_deg < _NARROW_DEG):
        angle = (
            ""
            if angle_deg is None
            else "for half of the map's points, the directions from which the cameras saw them differ by "
            f"less than {angle_deg:.1f}°"
        )
        forward = (
            f"every camera moved in its viewing direction for {format_percent(min(forward_shares))} of its "
            "path"
            if only_forward
            else ""
        )
        yield Advice(
            action="Start with a few steps to the side, and walk in an arc around a near object: only "
            "sideways movement shows depth.",
            reason=" and ".join(part for part in (forward, angle) if part),
            priority=1.2,
        )


def _about_start_and_end(inputs: ReportInputs) -> Iterator[Advice]:
    """Recommend starting all cameras before the movement and stopping all cameras after the movement.

    The recommendation is given if a camera has no measurement at the motion's start or end. If shortening
    this capture helps, the recommendation also gives values for start_s and end_s.
    """
    merge = inputs.merge
    if merge is None or not merge.trajectories:
        return
    start_s, end_s = merge.times_ns()[[0, -1]] * 1e-9
    measured = {}
    mounted = {mount.camera for mount in merge.mounts}
    for path in (path for path in merge.trajectories if path.camera in mounted):
        times = common_times_s(inputs, path.camera, path.times_ns)[path.localised]
        if len(times):
            measured[path.camera] = (float(times[0]), float(times[-1]))
    late = {name: first for name, (first, _) in measured.items() if first - start_s > _MAX_GAP_S}
    early = {name: last for name, (_, last) in measured.items() if end_s - last > _MAX_GAP_S}
    cuts = [f"start_s: {max(late.values()):.2f}"] if late else []
    cuts += [f"end_s: {min(early.values()):.2f}"] if early else []
    missing = [f"{name} has no measurement before {time:.2f} s" for name, time in late.items()]
    missing += [f"{name} has no measurement after {time:.2f} s" for name, time in early.items()]
    # If one camera ended before another camera started, shortening the capture does not help.
    remaining_s = min(early.values(), default=end_s) - max(late.values(), default=start_s)
    how = (
        f"To use only the common part of this capture, write {' and '.join(cuts)} under `capture:` in the "
        "job file."
        if remaining_s > 0.0
        else ""
    )
    if missing:
        yield Advice(
            action="Start all cameras before the movement and stop all cameras after the movement.",
            how=how,
            reason=f"the motion runs from {start_s:.2f} s to {end_s:.2f} s, but {', '.join(missing)}",
            priority=1.4,
        )


def _median_triangulation_deg(scene: Map) -> float | None:
    """Return the median triangulation angle of the points, degrees; None without observations.

    The triangulation angle of a point is the largest angle between the ray of the point's first observation
    and the ray of any other observation.
    """
    if len(scene.obs_point) == 0:
        return None
    rays = scene.map_from_cam[scene.obs_keyframe, :3, 3] - scene.points[scene.obs_point]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    order = np.argsort(scene.obs_point, kind="stable")
    point = scene.obs_point[order]
    first = order[np.searchsorted(point, point)]
    cosine = np.clip((rays[order] * rays[first]).sum(axis=1), -1.0, 1.0)
    smallest_cosine = np.full(len(scene.points), 1.0)
    np.minimum.at(smallest_cosine, point, cosine)
    return float(np.degrees(np.arccos(np.median(smallest_cosine[np.unique(point)]))))


def _about_hinges(inputs: ReportInputs) -> Iterator[Advice]:
    """Yield advice about elbows and knees that the motion bends out of their plane."""
    hinges = {} if inputs.merge is None else inputs.merge.report.loose_hinges
    for hinge in hinges.values():
        finding, _, advice = hinge.known_to.partition(ADVICE_SEPARATOR)
        action, _, settings = advice.partition(", and ")
        yield Advice(
            action=as_sentence(action),
            reason=finding,
            priority=1.1 + hinge.sigma_m,
            how=as_sentence(settings),
        )
