"""Recommend changes for the next capture. Each recommendation follows from a measurement of this job."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.merge_report import ScaleReport
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import Map
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.frame_losses import FAST_DEG, PLAIN_RATIO, LossCause
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.verdict import (
    FAIR_GAP_S,
    GOOD_MOUNT_DEG,
    cameras_in_own_maps,
    describe_lens_misfit,
    describe_scale_error,
)

MAX_RECOMMENDATIONS = 3
"""Maximum number of recommendations. Nobody changes more at once, and the next capture shows what remains.
Evidence: none."""
_MIN_LOST_SHARE = 0.02
"""Minimum fraction of all frames that a cause of losses must affect to give a recommendation.

Evidence: none.
"""
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
_SUFFICIENT_SCALE_SIGMA = 0.02
"""Maximum relative sigma of the metric scale that needs no recommendation. Evidence: none."""
_T_POSE = re.compile(r",? or stand in a T-pose for two seconds first")
"""Pattern of the phrase about a T-pose in the advice that merging gives."""
_ADVICE_SEPARATOR = "; to reduce this, "
"""Text that separates the finding from the advice in the sentences that merging gives."""

_ACTIONS = {
    LossCause.DARK: "Switch lights on or film by day, and keep sleeves and straps away from the lens.",
    LossCause.FAST: "Turn and swing more slowly, or film at 60 frames per second or more.",
    LossCause.BLUR: "Use more light and an exposure time of 1/240 s or shorter: sharp frames with noise are "
    "better than blurred frames.",
    LossCause.PLAIN: "Put up posters or patterned cloth where the cameras look, or turn the cameras away "
    "from plain walls and ceilings.",
    LossCause.SHALLOW: "Turn the camera so that it sees both near and far objects, spread over the whole "
    "picture.",
    LossCause.UNKNOWN_PLACE: "Turn the camera so that it sees less of the wearer's body, keep other people "
    "out of the picture, and walk past each place more than once.",
    LossCause.CONTRADICTED: "Put up posters or patterned cloth where the cameras look, or turn the cameras "
    "away from plain walls and ceilings.",
    LossCause.DAMAGED: "Copy the video again from the camera's card. If it is damaged there, too, use "
    "another card.",
    LossCause.NO_MAP: "Let all cameras see the same places: walk in a loop and look around in each place.",
    LossCause.OTHER_MAP: "Turn more slowly between the parts of the video, and let the camera see the same "
    "things before and after.",
    LossCause.FROZEN: "Use a fast memory card and a fully charged battery, close other apps, and play "
    "the videos before the cameras are taken off.",
}
_OBSERVATIONS = {
    LossCause.DARK: "hardly any light reached the camera",
    LossCause.FAST: f"the camera turned more than {FAST_DEG:.0f}° from one frame to the next",
    LossCause.BLUR: f"the picture was blurred (sharpness below {BLUR_SHARPNESS_RATIO * 100:.0f} % of the "
    "frames near it)",
    LossCause.PLAIN: f"the camera looked at plain surfaces (the frames have under "
    f"{PLAIN_RATIO * 100:.0f} % of the camera's usual number of corners)",
    LossCause.SHALLOW: "the visible points did not determine the camera's position (the points are too far "
    "away or too close together)",
    LossCause.UNKNOWN_PLACE: "the picture was sharp and textured, but its content is not in the map",
    LossCause.CONTRADICTED: "the poses of this part contradict the rest of the map, so they were left out",
    LossCause.NO_MAP: "no map contains the camera",
    LossCause.OTHER_MAP: "this part is in another map, whose place in the room is not known",
    LossCause.DAMAGED: "the video file is damaged there",
    LossCause.FROZEN: "the recording repeated one picture instead of new ones",
}
"""Observation that explains each cause of a loss. The limits are those of `frame_losses`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recommendation:
    """One change for the next capture.

    Attributes:
        action: The change that the user should make, in the words of a film maker.
        reason: The measurement that justifies the change.
        priority: Importance of the recommendation. Larger values are shown first.
        how: Commands and settings for the change; "" if the action needs none.
    """

    action: str
    reason: str
    priority: float
    how: str = ""


def recommend_changes(inputs: ReportInputs, lost: Mapping[str, Counter[LossCause]]) -> list[Recommendation]:
    """Return at most three recommendations for the next capture, the most helpful recommendation first.

    Args:
        inputs: The results of the job.
        lost: Number of lost frames, by camera name and cause.
    """
    mirrored = _mirrored_cameras(inputs)
    found = [
        *_about_losses(inputs, {name: causes for name, causes in lost.items() if name not in mirrored}),
        *_about_mirrored_cameras(inputs),
        *_about_lenses(inputs),
        *_about_overlap(inputs),
        *_about_parallax(inputs),
        *_about_start_and_end(inputs),
        *_about_body(inputs),
    ]
    ordered = sorted(_combine_t_poses(found), key=lambda recommendation: -recommendation.priority)
    return ordered[:MAX_RECOMMENDATIONS]


def _combine_t_poses(found: Sequence[Recommendation]) -> list[Recommendation]:
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
    combined = Recommendation(
        action="Stand still for two seconds before you start, with the arms stretched out to the sides (a "
        "T-pose). This reduces the uncertainty of the mounts and of the scale.",
        reason="no T-pose was found, and sizes or the directions of cameras on their bones are not well "
        "known",
        priority=max(recommendation.priority for recommendation in improved) + 1e-3,
    )
    return [*others, combined]


def _map_diagnostics(inputs: ReportInputs) -> MapDiagnostics:
    """Return mapping's diagnostics, read from the metrics. They are empty without metrics."""
    return MapDiagnostics.from_log((inputs.metrics or {}).get("mapping", {}))


def _mirrored_cameras(inputs: ReportInputs) -> Sequence[str]:
    """Return the names of the cameras that the map excludes because their videos are mirrored."""
    return _map_diagnostics(inputs).flipped_cameras


def _about_mirrored_cameras(inputs: ReportInputs) -> Iterator[Recommendation]:
    """Recommend to mirror the videos of mirrored cameras back.

    If it is unknown which of two groups of cameras is mirrored, recommend to look for text in their videos.
    """
    if names := _mirrored_cameras(inputs):
        yield Recommendation(
            action=f"Flip the video of {', '.join(names)} back, and switch off the mirroring in the front "
            "camera or the app.",
            how="`ffmpeg -i in.mp4 -vf hflip out.mp4` flips a video.",
            reason="compared with the other cameras, left and right are exchanged in this video, and a "
            "mirrored video is not used in the map",
            priority=3.0,
        )
    for one, other in _map_diagnostics(inputs).undecided_groups:
        yield Recommendation(
            action=f"Check whether text reads backwards in the video of {', '.join(one)} or "
            f"{', '.join(other)}. If text reads backwards, flip that video back. If text reads correctly in "
            "all of these videos, cover wall mirrors.",
            how="`ffmpeg -i in.mp4 -vf hflip out.mp4` flips a video.",
            reason="these cameras see mirror images of each other; it is unknown which video is mirrored",
            priority=3.0,
        )


def _about_lenses(inputs: ReportInputs) -> Iterator[Recommendation]:
    """Recommend to correct calibrations that the map contradicts.

    The priority is high, because all other results depend on the calibrations.
    """
    misfits = _map_diagnostics(inputs).misfit_factors
    if misfits:
        fits = "; ".join(
            f"{name} has {describe_lens_misfit(factor)}" for name, factor in sorted(misfits.items())
        )
        yield Recommendation(
            action="Calibrate the camera in the video mode of this capture, with stabilisation and digital "
            "zoom off; or run the job again and let the program find the lens.",
            how="Film a board and use `bodycap calibrate`; or write `calibration: auto` under `capture:` in "
            "the job file.",
            reason=f"according to the pictures, {fits} than the calibration says",
            priority=3.0,
        )


def _as_sentence(text: str) -> str:
    if not text:
        return ""
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"


def _about_losses(inputs: ReportInputs, lost: Mapping[str, Counter[LossCause]]) -> Iterator[Recommendation]:
    total = sum(len(registration.trajectory.status) for registration in inputs.registrations)
    if not total:
        return
    all_cameras: Counter[LossCause] = sum(lost.values(), Counter())
    for cause, frames in all_cameras.most_common():
        if frames < _MIN_LOST_SHARE * total:
            continue
        by_camera = [f"{counts[cause]} of {name}" for name, counts in sorted(lost.items()) if counts[cause]]
        yield Recommendation(
            action=_ACTIONS[cause],
            reason=f"{frames} frames were lost where {_OBSERVATIONS[cause]} ({', '.join(by_camera)})",
            priority=1.0 + frames / total,
        )


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


def _about_overlap(inputs: ReportInputs) -> Iterator[Recommendation]:
    """Recommend to film common places with each camera that shares few points with any other camera."""
    if len(inputs.cameras) < 2 or not inputs.maps:
        return
    shared = count_shared_points(inputs.maps, inputs.cameras)
    for index, name in enumerate(inputs.cameras):
        own = int(shared[index, index])
        best = int(np.delete(shared[index], index).max(initial=0))
        if own and best < _MIN_SHARED_SHARE * own:
            yield Recommendation(
                action=f"Let {name} see the same places as the other cameras: hold this camera forward for "
                "a few steps, and walk past the same places twice.",
                reason=f"no other camera sees more than {best:,} of the {own:,} points that {name} sees",
                priority=1.5,
            )


def _about_parallax(inputs: ReportInputs) -> Iterator[Recommendation]:
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
        yield Recommendation(
            action="Start with a few steps to the side, and walk in an arc around a near object: only "
            "sideways movement shows depth.",
            reason=" and ".join(part for part in (forward, angle) if part),
            priority=1.2,
        )


def _about_start_and_end(inputs: ReportInputs) -> Iterator[Recommendation]:
    """Recommend starting all cameras before the movement and stopping all cameras after the movement.

    The recommendation is given if a camera has no measurement at the motion's start or end. If shortening
    this capture helps, the recommendation also gives values for start_s and end_s.
    """
    merge = inputs.merge
    if merge is None or not merge.trajectories:
        return
    start_s, end_s = merge.times_ns()[[0, -1]] * 1e-9
    measured = {}
    for path in merge.trajectories:
        times = common_times_s(inputs, path.camera, path.times_ns)[path.localised]
        if len(times):
            measured[path.camera] = (float(times[0]), float(times[-1]))
    late = {name: first for name, (first, _) in measured.items() if first - start_s > FAIR_GAP_S}
    early = {name: last for name, (_, last) in measured.items() if end_s - last > FAIR_GAP_S}
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
        yield Recommendation(
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


def _clock_notes(inputs: ReportInputs, cameras: Sequence[str]) -> str:
    return "; ".join(f"{name}: {note}" for name in cameras for note in inputs.clocks[name].notes)


def _about_body(inputs: ReportInputs) -> Iterator[Recommendation]:
    """Yield recommendations about the body: exchanged sides, wrong clocks, and constants not well known."""
    if inputs.merge is None:
        return
    report = inputs.merge.report
    if report.exchanged_sides is not None:
        yield Recommendation(
            action="Exchange the names (or mounts) of the left and the right cameras, and run the job again.",
            reason=report.exchanged_sides.says,
            priority=2.8,
        )
    if report.still_cameras:
        names = " and ".join(sorted(report.still_cameras))
        yield Recommendation(
            action=f"Fasten {names} so that it stays on the body until the end.",
            reason=f"{names} stood still in the room for some time while the person moved",
            priority=2.7,
        )
    unknown = sorted(name for name, clock in inputs.clocks.items() if not clock.is_known)
    own_maps = set() if inputs.metrics is None else cameras_in_own_maps(inputs.metrics)
    if elsewhere := [name for name in unknown if name in own_maps]:
        yield Recommendation(
            action=f"Check that the video of {' and '.join(elsewhere)} is of this recording, and let all "
            "cameras see the same places. Clap once while they record with sound.",
            reason=_clock_notes(inputs, elsewhere),
            priority=2.95,
        )
    if unknown := [name for name in unknown if name not in own_maps]:
        yield Recommendation(
            action="Clap once, or hop once, while all cameras record with sound.",
            how="For this recording, read the time of an event in two videos and state `offset_s` of the "
            f"camera in the job file: the time in the video of {inputs.reference_camera} minus the time in "
            "the camera's own video.",
            reason=_clock_notes(inputs, unknown),
            priority=2.9,
        )
    contradicted = sorted(name for name, clock in inputs.clocks.items() if clock.is_contradicted)
    if contradicted:
        yield Recommendation(
            action="Correct the stated clock offset, or leave it out, so that it is estimated.",
            how=f"`offset_s` is the time of an event in the video of {inputs.reference_camera} minus its "
            "time in the camera's own video.",
            reason="; ".join(
                f"{name}: {note}" for name in contradicted for note in inputs.clocks[name].notes
            ),
            priority=2.5,
        )
    bones = {mount.role for mount in inputs.mounts}
    yield from _about_scale(report.scale, has_t_pose=report.t_pose is not None, is_one_bone=len(bones) == 1)
    for hinge in report.loose_hinges.values():
        finding, _, advice = hinge.known_to.partition(_ADVICE_SEPARATOR)
        action, _, settings = advice.partition(", and ")
        yield Recommendation(
            action=_as_sentence(action),
            reason=finding,
            priority=1.1 + hinge.sigma_m,
            how=_as_sentence(settings),
        )
    for name, mount in report.mounts.items():
        finding, _, advice = mount.known_to.partition(_ADVICE_SEPARATOR)
        if advice or mount.sigma_deg > GOOD_MOUNT_DEG:
            measure = f"measure how {name} sits on its bone"
            yield Recommendation(
                action=_as_sentence(f"at the start of the take, {advice}" if advice else measure),
                reason=f"the direction of {name} on its bone is known to about ± {mount.sigma_deg:.0f}°",
                priority=1.0 + mount.sigma_deg / 1000.0,
                how=f"Or {measure}, and give it in the job file: `joint_from_cam` of the camera."
                if advice
                else "Give it in the job file: `joint_from_cam` of the camera.",
            )


def _about_scale(scale: ScaleReport, *, has_t_pose: bool, is_one_bone: bool) -> Iterator[Recommendation]:
    sigma = scale.relative_sigma
    if sigma <= _SUFFICIENT_SCALE_SIGMA:
        return
    used = {source.name for source in scale.sources if source.used}
    how = [
        "for a distance, `merge: {known_distance: [torso:0, torso:120, 2.50]}` in the job file, the metres "
        "between the camera's places in two frames",
        "for a board, `merge: {marker_board: {square_m: 0.1, columns: 7, rows: 5}}`",
    ]
    if is_one_bone:
        action = "Wear a camera on another bone as well (a hand, an upper arm or the head)"
    elif "mean stature" in used:
        action = "Give the height of the person"
        how.insert(0, "for the height, `--height 1.75`")
    elif used & {"known distance", "marker board"}:
        return
    else:
        action = "Put a board of printed squares on the floor, or measure how far the person walks"
    if "skeleton" not in used:
        how.append("the person's own skeleton (`--skeleton subject.bvh`) is more accurate than the height")
    t_pose = "" if has_t_pose else ", or stand in a T-pose for two seconds first"
    yield Recommendation(
        action=f"{action}{t_pose}.",
        reason=f"sizes are known to about {describe_scale_error(sigma)}",
        priority=1.1 + sigma,
        how=_as_sentence("; ".join(how)),
    )
