"""Where maps without a common view start: the walk their cameras share, and the body at ease."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import LIMB_CHAINS, Bone
from bodycap_batch.merging.body.provisional_scale import (
    distance_constraint,
    kinematic_neighbours,
    provisional_scale,
)
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack, transform_track
from bodycap_batch.model.geometry import Similarity, invert, make_transform
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_SMOOTHING_S = 0.75
"""Half the time over which paths are averaged: a stride swings the arms once in about a second."""
_REST_POSE_WEIGHT = 0.06
"""Weight of the body's stance at ease beside the walk's shape, both of size one: 20 degrees against 15 cm on
a walk of metres."""
_MIN_COMMON_S = 4.0
"""Four strides: less path than that has no shape to compare."""
_MIN_INSTANTS = 3
_MIN_COMMON_FRAMES = 10
"""Points of the walk, and frames of both cameras, without which there is nothing to compare."""
_MAX_SCALE_SIGMA = 0.25
"""Sigma of the log of the scale, from how far off mounts may be, beyond which cameras that sit close
together do not tell it: a forearm's and its palm's have 0.4, a shin's and its foot's 0.3 (taken at their
word, they lay 12 to 49 cm off at 4 cm stated), an upper arm's beside the trunk's 0.15."""
_ITERATIONS = 3
"""Of finding the start and the metric scale in turn; the first knows no lengths."""


@dataclass(frozen=True, slots=True)
class InitialAlignment:
    """Where further maps start.

    Attributes:
        places: By gauge, main_from_gauge.
        metric: Metres per unit of the main map.
        told: Whether more than what was put where it is at ease tells `metric`, and not just roughly.
        spanned: Whether one map holds the trunk and the end of a limb, which tells it with no map placed.
    """

    main_from_gauge: dict[str, Similarity]
    metres_per_unit: float
    scale_observable: bool
    one_map_spans_a_limb: bool


def align_maps_initially(
    bones: Sequence[Bone],
    main: Sequence[CameraTrack],
    others: Sequence[tuple[str, Sequence[CameraTrack]]],
    mounts: Mapping[str, Mount],
) -> InitialAlignment:
    """Where the maps start, and metres per unit of the main map: each helps to find the other.

    How far a hand reaches from a shoulder in another map does not tell the scale: the hand was put there by
    the length of an arm at ease, and the less there is of the scale, the less its swinging adds to that. Nor
    does the distance of a trunk and a head in maps of their own: it is the one at ease, whatever the scale.

    Raises:
        EstimationError: Nothing tells the scale, or the cameras' distances fit no person.
    """
    guessed, sigma_log = _scale_information(bones, [main, *(group for _, group in others)], mounts)
    metric, starts = np.inf, {}
    for _ in range(_ITERATIONS):
        starts = {gauge: align_map(bones, main[0], group, (mounts, metric)) for gauge, group in others}
        placed = [transform_track(track, starts[gauge]) for gauge, group in others for track in group]
        metric = provisional_scale(bones, [*main, *placed], mounts, guessed if np.isfinite(sigma_log) else ())
    return InitialAlignment(
        starts,
        metric,
        bool(sigma_log <= _MAX_SCALE_SIGMA),
        _one_map_spans_a_limb(bones, [main, *(group for _, group in others)]),
    )


def _one_map_spans_a_limb(bones: Sequence[Bone], groups: Sequence[Sequence[CameraTrack]]) -> bool:
    """Whether a trunk's camera and a hand's or foot's, or a forearm's or shin's, are in one map."""
    roles = [[split_side(bones[track.bone].role) for track in group] for group in groups]
    near = ("Shoulder", "Arm", "UpLeg")
    return any(
        any(not side for side, _ in group) and any(side and part not in near for side, part in group)
        for group in roles
    )


def _scale_information(
    bones: Sequence[Bone], groups: Sequence[Sequence[CameraTrack]], mounts: Mapping[str, Mount]
) -> tuple[set[str], float]:
    """Cameras whose distance from a relative in another map is a guess, and how well others tell the scale.

    Across maps only a limb that swings about a joint of its relative's bone tells something. What each tells
    depends on how far apart its camera and the relative's are, and how well their mounts are known.

    Raises:
        EstimationError: None does, and a camera that hardly swings has a map of its own.
    """
    where = {track.camera: index for index, group in enumerate(groups) for track in group}
    guessed, still, information = set(), [], 0.0
    for track, other in kinematic_neighbours(bones, [track for group in groups for track in group]):
        link = distance_constraint(bones, track, other, mounts)
        if link is None:
            continue
        _, fixed, reach = link
        swings = reach == 0.0 and split_side(bones[track.bone].role)[1] in LIMB_CHAINS
        if where[track.camera] == where[other.camera] or swings:
            apart = reach + float(np.linalg.norm(fixed, axis=1).mean())
            information += apart**2 / (mounts[track.camera].sigma_m ** 2 + mounts[other.camera].sigma_m ** 2)
        else:
            guessed.add(track.camera)
            still += [(track.camera, other.camera)] if reach == 0.0 else []
    if still and not information:
        raise EstimationError(
            "the distance of {!r} from {!r} in another map tells no scale, nor does anything else".format(
                *still[0]
            ),
            hint="an upper arm's camera, or two cameras of the body in one map, tell it",
        )
    return guessed, 1.0 / np.sqrt(information) if information else np.inf


def align_map(
    bones: Sequence[Bone],
    main: CameraTrack,
    group: Sequence[CameraTrack],
    body: tuple[Mapping[str, Mount], float],
) -> Similarity:
    """Place a map by the walk its cameras share with the trunk's, and by the body at ease.

    Args:
        bones: The graph's bones.
        main: The trunk's camera in the main map.
        group: The further map's cameras.
        body: Where cameras usually sit, and metres per unit of the main map, infinite where unknown.
    """
    mounts, metric = body
    at_ns = _instants(main)
    pairs, turns = [], []
    for track in group:
        at_ease = _rest_pose(bones, mounts[main.camera], main.bone)
        cam_from_cam = invert(at_ease) @ _rest_pose(bones, mounts[track.camera], track.bone)
        cam_from_cam[:3, 3] /= metric
        expected = replace(main, map_from_cam=main.map_from_cam @ cam_from_cam)
        target, path = _smoothed_path(expected, at_ns), _smoothed_path(track, at_ns)
        seen = np.isfinite(target[:, 0]) & np.isfinite(path[:, 0])
        if seen.sum() >= _MIN_INSTANTS:
            pairs.append((target[seen], path[seen]))
        poses, valid = expected.poses_at(track.times_ns, max_gap_ns=200_000_000)
        turn = poses[valid, :3, :3] @ np.swapaxes(track.map_from_cam[valid, :3, :3], 1, 2)
        turns.append(turn.mean(axis=0) if valid.any() else np.zeros((3, 3)))
    centred = [(mine - mine.mean(axis=0), path - path.mean(axis=0)) for mine, path in pairs]
    mine, path = (np.concatenate(parts) for parts in zip(*centred, strict=True))
    sizes = [float(np.sqrt((part**2).sum(axis=1).mean())) for part in (mine, path)]
    walked = mine.T @ path / (len(mine) * sizes[0] * sizes[1])
    u, _, vt = np.linalg.svd(walked + _REST_POSE_WEIGHT * np.mean(turns, axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = sizes[0] / sizes[1]
    shifts = [a.mean(axis=0) - scale * rotation @ b.mean(axis=0) for a, b in pairs]
    return Similarity(scale, rotation, np.mean(shifts, axis=0))


def require_common_time(main: CameraTrack, group: Sequence[CameraTrack]) -> None:
    """Raise where no camera of a map was localised while the trunk's was for some seconds."""
    at_ns = _instants(main)
    walked = np.isfinite(_smoothed_path(main, at_ns)[:, 0])
    for track in group:
        seen = (main.times_ns >= track.times_ns[0]) & (main.times_ns <= track.times_ns[-1])
        # A few frames here and there span a time, but show no path.
        path = walked & np.isfinite(_smoothed_path(track, at_ns)[:, 0])
        together = track.poses_at(main.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1]
        long = seen.any() and np.ptp(main.times_ns[seen]) * 1e-9 >= _MIN_COMMON_S
        if long and path.sum() >= _MIN_INSTANTS and together.sum() >= _MIN_COMMON_FRAMES:
            return
    raise EstimationError(
        f"{group[0].camera!r} and {main.camera!r} were localised together for less than {_MIN_COMMON_S:g} s",
        hint="maps without a common view are joined by the walk; see frames.csv",
    )


def _instants(track: CameraTrack) -> IntArray:
    """About four instants a second at which a track was localised."""
    return track.times_ns[:: max(1, round(0.25e9 / float(np.median(np.diff(track.times_ns)))))]


def _smoothed_path(track: CameraTrack, at_ns: IntArray) -> FloatArray:
    """Mean position (N,3) of a track around given times; NaN where half of the stretch was not localised."""
    total = np.vstack([np.zeros(3), np.cumsum(track.map_from_cam[:, :3, 3], axis=0)])
    reach = round(_SMOOTHING_S * 1e9)
    low, high = (np.searchsorted(track.times_ns, at_ns + sign * reach) for sign in (-1, 1))
    count = high - low
    usual = 2.0 * reach / float(np.median(np.diff(track.times_ns)))
    mean = (total[high] - total[low]) / np.maximum(count, 1)[:, None]
    return np.asarray(np.where((count > 0.5 * usual)[:, None], mean, np.nan))


def _rest_pose(bones: Sequence[Bone], mount: Mount, bone: int) -> FloatArray:
    """Pose (4,4) of a camera in the first bone's frame while the body is at ease."""
    pose, current = np.array(mount.joint_from_cam), bone
    while bones[current].parent >= 0:
        pose = make_transform(bones[current].mean_rotation, bones[current].offset_m) @ pose
        current = bones[current].parent
    return pose
