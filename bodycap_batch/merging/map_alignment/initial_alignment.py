"""The initial alignment of maps that share no view, from the path of the body and its rest pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import LIMB_CHAINS, Bone, bones_to_root
from bodycap_batch.merging.body.provisional_scale import (
    MIN_COMMON_FRAMES,
    distance_constraint,
    kinematic_neighbours,
    provisional_scale,
)
from bodycap_batch.merging.cameras.track import (
    MAX_COARSE_GAP_NS,
    MAX_SAMPLE_GAP_NS,
    CameraTrack,
    transform_track,
)
from bodycap_batch.model.geometry import Similarity, invert, make_transform, nearest_rotation
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_SMOOTHING_S = 0.75
"""Half of the duration (seconds) over which paths are averaged. The average removes the swing of a walker's
arms, which lasts about a second."""
_REST_POSE_WEIGHT = 0.06
"""Weight of the camera orientations in the rest pose, relative to the shape of the path. Both are normalised.
With this weight, an orientation error of 20 degrees has the same effect as a path error of 15 cm on a walk of
a few metres. Evidence: none."""
_MIN_COMMON_S = 4.0
"""Minimum time (seconds) that two cameras must share. The value is about four strides. The shape of a shorter
path does not determine the alignment."""
_MIN_INSTANTS = 3
"""Minimum number of points of the shared path. Three points determine a rotation."""
_MAX_SCALE_SIGMA = 0.25
"""Maximum sigma of the log of an observable scale. A scale with a larger sigma is treated as not observable.
The sigma comes from the uncertainty of the mounts. Evidence: docs/decisions/merging.md."""
_ITERATIONS = 3
"""Number of times that the initial similarities and the metric scale are estimated in turn. The first
similarities are estimated without a scale."""


@dataclass(frozen=True, slots=True)
class InitialAlignment:
    """The initial similarities of further maps.

    Attributes:
        main_from_gauge: By gauge of a further map, the similarity from this map to the main map.
        metres_per_unit: Scale of the main map, metres per map unit.
        scale_observable: True if distances that do not depend on the rest pose determine the scale well.
        one_map_spans_a_limb: True if one map contains a camera on the trunk and a camera at the end of a
            limb. The scale then does not depend on the alignment.
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
    """Estimate the similarities of further maps and the metric scale in turn.

    Some distances between cameras in different maps contain no information about the scale. One example is
    the distance between shoulder and hand. At every scale, the alignment places the hand as far from the
    shoulder as it is in the rest pose: one arm length. A smaller scale only makes the swing of the arm
    smaller. Another example is the distance between trunk and head. At every scale, this distance equals the
    distance in the rest pose.

    Args:
        bones: The graph's bones.
        main: Tracks of the main map, the track of the trunk's camera first.
        others: Gauge and tracks of each further map.
        mounts: Mount of each camera by camera name.

    Raises:
        EstimationError: Nothing determines the scale, or the cameras' distances are impossible for a person.
    """
    groups = [main, *(group for _, group in others)]
    uninformative, sigma_log = _scale_information(bones, groups, mounts)
    ignored = uninformative if np.isfinite(sigma_log) else ()
    metres_per_unit, similarities = np.inf, {}
    for _ in range(_ITERATIONS):
        similarities = {
            gauge: align_map(bones, main[0], group, mounts, metres_per_unit) for gauge, group in others
        }
        aligned = [transform_track(track, similarities[gauge]) for gauge, group in others for track in group]
        metres_per_unit = provisional_scale(bones, [*main, *aligned], mounts, ignored)
    return InitialAlignment(
        main_from_gauge=similarities,
        metres_per_unit=metres_per_unit,
        scale_observable=bool(sigma_log <= _MAX_SCALE_SIGMA),
        one_map_spans_a_limb=_one_map_spans_a_limb(bones, groups),
    )


def _one_map_spans_a_limb(bones: Sequence[Bone], groups: Sequence[Sequence[CameraTrack]]) -> bool:
    """Return True if one map contains a camera on the trunk and a camera near the end of a limb.

    Cameras on shoulders, upper arms and thighs are not near the end of a limb.
    """
    roles = [[split_side(bones[track.bone].role) for track in group] for group in groups]
    near = ("Shoulder", "Arm", "UpLeg")
    return any(
        any(not side for side, _ in group) and any(side and part not in near for side, part in group)
        for group in roles
    )


def _scale_information(
    bones: Sequence[Bone], groups: Sequence[Sequence[CameraTrack]], mounts: Mapping[str, Mount]
) -> tuple[set[str], float]:
    """Return how well the distances between cameras determine the scale.

    A distance between cameras in different maps contains information only if one camera is on a limb bone,
    and if this bone swings about a joint of the other camera's bone. The amount of information depends on the
    distance between the two cameras, and on the uncertainty of their mounts.

    Returns:
        Names of cameras whose distance from a kinematic neighbour in another map contains no information
        about the scale. Then the sigma of the scale's logarithm from the distances of the other cameras;
        infinite without such distances.

    Raises:
        EstimationError: No distance contains information, and a camera that hardly swings is in a separate
            map.
    """
    map_of = {track.camera: index for index, group in enumerate(groups) for track in group}
    uninformative, without_swing, information = set(), [], 0.0
    for track, other in kinematic_neighbours(bones, [track for group in groups for track in group]):
        constraint = distance_constraint(bones, track, other, mounts)
        if constraint is None:
            continue
        swings = constraint.reach_m == 0.0 and split_side(bones[track.bone].role)[1] in LIMB_CHAINS
        if map_of[track.camera] == map_of[other.camera] or swings:
            offset = float(np.linalg.norm(constraint.mount_offsets_m, axis=1).mean())
            apart = constraint.reach_m + offset
            information += apart**2 / (mounts[track.camera].sigma_m ** 2 + mounts[other.camera].sigma_m ** 2)
        else:
            uninformative.add(track.camera)
            without_swing += [(track.camera, other.camera)] if constraint.reach_m == 0.0 else []
    if without_swing and not information:
        raise EstimationError(
            "{!r} and {!r} are in different maps, so their distance does not determine the scale, and no "
            "other distance determines the scale".format(*without_swing[0]),
            hint="wear a camera on an upper arm, or let two cameras film the same places, so that both "
            "cameras are in one map",
        )
    return uninformative, 1.0 / float(np.sqrt(information)) if information else np.inf


def align_map(
    bones: Sequence[Bone],
    main: CameraTrack,
    group: Sequence[CameraTrack],
    mounts: Mapping[str, Mount],
    metres_per_unit: float,
) -> Similarity:
    """Estimate the similarity of a further map to the main map, from smoothed paths and the rest pose.

    Args:
        bones: The graph's bones.
        main: Track of the trunk's camera in the main map.
        group: Tracks of the further map's cameras.
        mounts: Mount of each camera by camera name.
        metres_per_unit: Scale of the main map, metres per map unit; infinite if it is unknown.

    Returns:
        The similarity main_from_gauge of the further map.
    """
    at_ns = _instants(main)
    pairs, rotations = [], []
    for track in group:
        main_at_rest = _rest_pose(bones, mounts[main.camera], main.bone)
        cam_from_cam = invert(main_at_rest) @ _rest_pose(bones, mounts[track.camera], track.bone)
        cam_from_cam[:3, 3] /= metres_per_unit
        expected = replace(main, map_from_cam=main.map_from_cam @ cam_from_cam)
        target, source = _smoothed_path(expected, at_ns), _smoothed_path(track, at_ns)
        common = np.isfinite(target[:, 0]) & np.isfinite(source[:, 0])
        if common.sum() >= _MIN_INSTANTS:
            pairs.append((target[common], source[common]))
        poses, valid = expected.poses_at(track.times_ns, max_gap_ns=MAX_COARSE_GAP_NS)
        rotation = poses[valid, :3, :3] @ np.swapaxes(track.map_from_cam[valid, :3, :3], 1, 2)
        rotations.append(rotation.mean(axis=0) if valid.any() else np.zeros((3, 3)))
    centred = [(a - a.mean(axis=0), b - b.mean(axis=0)) for a, b in pairs]
    target, source = (np.concatenate(parts) for parts in zip(*centred, strict=True))
    sizes = [float(np.sqrt((part**2).sum(axis=1).mean())) for part in (target, source)]
    by_path = target.T @ source / (len(target) * sizes[0] * sizes[1])
    rotation = nearest_rotation(by_path + _REST_POSE_WEIGHT * np.mean(rotations, axis=0))
    scale = sizes[0] / sizes[1]
    shifts = [a.mean(axis=0) - scale * rotation @ b.mean(axis=0) for a, b in pairs]
    return Similarity(scale, rotation, np.mean(shifts, axis=0))


def require_common_time(main: CameraTrack, group: Sequence[CameraTrack]) -> None:
    """Check that a camera of a further map was localised for a few seconds together with the trunk's camera.

    Raises:
        EstimationError: No camera of the further map was localised for long enough together with the trunk's
            camera.
    """
    at_ns = _instants(main)
    main_known = np.isfinite(_smoothed_path(main, at_ns)[:, 0])
    for track in group:
        inside = (main.times_ns >= track.times_ns[0]) & (main.times_ns <= track.times_ns[-1])
        # A few isolated frames may span a long time, but they give no path.
        both_known = main_known & np.isfinite(_smoothed_path(track, at_ns)[:, 0])
        valid = track.poses_at(main.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1]
        long = inside.any() and np.ptp(main.times_ns[inside]) * 1e-9 >= _MIN_COMMON_S
        if long and both_known.sum() >= _MIN_INSTANTS and valid.sum() >= MIN_COMMON_FRAMES:
            return
    raise EstimationError(
        f"the cameras {group[0].camera!r} and {main.camera!r} were localised at the same time for less "
        f"than {_MIN_COMMON_S:g} s",
        hint="record a longer walk with both cameras: maps without a common place are aligned by the walk "
        "that both cameras record (frames.csv lists why frames were lost)",
    )


def _instants(track: CameraTrack) -> IntArray:
    """Return times (N,), about four per second, at which a track was localised."""
    return track.times_ns[:: max(1, round(0.25e9 / float(np.median(np.diff(track.times_ns)))))]


def _smoothed_path(track: CameraTrack, at_ns: IntArray) -> FloatArray:
    """Return the mean positions (N,3) of a track around given times (N,).

    The position is NaN if at most half of the usual number of frames around a time is localised.
    """
    total = np.vstack([np.zeros(3), np.cumsum(track.map_from_cam[:, :3, 3], axis=0)])
    half_ns = round(_SMOOTHING_S * 1e9)
    low, high = (np.searchsorted(track.times_ns, at_ns + sign * half_ns) for sign in (-1, 1))
    count = high - low
    usual = 2.0 * half_ns / float(np.median(np.diff(track.times_ns)))
    mean = (total[high] - total[low]) / np.maximum(count, 1)[:, None]
    return np.asarray(np.where((count > 0.5 * usual)[:, None], mean, np.nan))


def _rest_pose(bones: Sequence[Bone], mount: Mount, bone: int) -> FloatArray:
    """Return the pose (4,4) of a camera in the first bone's frame, with the body in the rest pose."""
    pose = np.array(mount.joint_from_cam)
    for index in bones_to_root(bones, bone)[:-1]:
        pose = make_transform(bones[index].mean_rotation, bones[index].offset_m) @ pose
    return pose
