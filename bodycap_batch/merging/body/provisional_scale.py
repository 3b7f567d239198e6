"""A provisional metric scale from the distances between cameras, before the motion is solved."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError, ImplausibleBody
from bodycap_batch.merging.body.bones import LIMB_CHAINS, Bone, bones_to_root
from bodycap_batch.merging.cameras.track import MAX_COARSE_GAP_NS, CameraTrack
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_REACH_QUANTILE = 0.9
"""This quantile of the distances is used instead of the maximum of the distances. A single wrong pose hardly
changes the quantile."""
_MAX_EXTENSION = 0.96
"""Distance between the ends of a stretched limb, divided by the limb's length. The ratio is below 1, because
the elbows of a walking person keep 15 to 30° of flexion."""
MIN_COMMON_FRAMES = 10
"""Minimum number of frames in which two cameras are localised at the same time. With fewer such frames, the
distance between the two cameras is not used. Evidence: none."""


@dataclass(frozen=True, slots=True)
class DistanceConstraint:
    """Bound on the distance between two points of the body, each measured by a camera.

    At a given scale, the vector between the points is ``scale · camera_offsets + mount_offsets_m``.

    Attributes:
        camera_offsets: (N,3) differences of the two cameras' centres, map units.
        mount_offsets_m: (N,3) vector from the first camera to the first point, minus the vector from the
            second camera to the second point, metres. Both vectors follow from the mounts.
        reach_m: Maximum length (metres) of the vector; 0 if both points are the same point of the body.
    """

    camera_offsets: FloatArray
    mount_offsets_m: FloatArray
    reach_m: float

    def typical_scale(self) -> float:
        """Return the scale (metres per map unit) that explains the median distance of the cameras."""
        expected = self.reach_m + np.linalg.norm(self.mount_offsets_m, axis=1).mean()
        measured = float(np.median(np.linalg.norm(self.camera_offsets, axis=1)))
        return float(expected / max(measured, 1e-12))

    def cost(self, scale: float) -> float:
        """Return the misfit (metres) of a scale.

        The cost is the absolute difference between the largest distance and the length of a stretched limb.
        If both points are the same point of the body, the cost is the median distance between them.
        """
        distance = np.linalg.norm(scale * self.camera_offsets + self.mount_offsets_m, axis=1)
        if self.reach_m > 0.0:
            return abs(float(np.quantile(distance, _REACH_QUANTILE)) - _MAX_EXTENSION * self.reach_m)
        return float(np.median(distance))


def provisional_scale(
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    mounts: Mapping[str, Mount],
    ignored_cameras: Collection[str] = (),
) -> float:
    """Estimate metres per map unit from the largest distances between cameras of related bones.

    At a given scale, each pair of cameras gives the distance between two points of the body. The lengths of
    the bones bound this distance. The result is the scale at which the largest distances equal the lengths of
    stretched limbs.

    Args:
        bones: The graph's bones.
        tracks: Tracks of all cameras, in the gauge of one map.
        mounts: Mount of each camera by camera name.
        ignored_cameras: Names of cameras whose distances from their kinematic neighbours are not used.

    Raises:
        EstimationError: No two related cameras were localised at the same time.
        ImplausibleBody: The distances fit no person.
    """
    links = [
        distance_constraint(bones, track, other, mounts)
        for track, other in kinematic_neighbours(bones, tracks)
        if track.camera not in ignored_cameras
    ]
    constraints = [link for link in links if link is not None]
    if not constraints:
        raise EstimationError(
            "no two cameras whose distance on the body is known were localised at the same time",
            hint="to determine the metric scale, wear a camera on the trunk and a camera on a limb or the "
            "head, and let both cameras film the same places",
        )
    typical = [constraint.typical_scale() for constraint in constraints]
    scales = float(np.median(typical)) * np.geomspace(0.2, 5.0, 320)
    costs = np.array([sum(constraint.cost(scale) for constraint in constraints) for scale in scales])
    best = int(np.argmin(costs))
    if best in (0, len(scales) - 1):
        raise ImplausibleBody(
            "the distances between the cameras are not possible for a person: the scale of "
            f"{scales[best]:.3g} m per map unit is out of bounds",
            hint="check that the `mount` of each camera in the job is correct; if a camera on a wrist looks "
            "at its hand, describe its place with `segment` and `joint_from_cam`",
        )
    return float(scales[best])


def kinematic_neighbours(
    bones: Sequence[Bone], tracks: Sequence[CameraTrack]
) -> list[tuple[CameraTrack, CameraTrack]]:
    """Pair each camera with a camera nearer to the root.

    The second camera is the camera of the nearest ancestor bone with a camera. If no ancestor has a camera,
    it is the camera nearest to the root.
    """
    out = []
    by_bone = {track.bone: track for track in reversed(tracks)}
    root = next((track for track in tracks if track.bone == min(by_bone)), tracks[0])
    for track in tracks:
        above = bones_to_root(bones, track.bone)[1:]
        other = next((by_bone[bone] for bone in above if bone in by_bone), root)
        if other is not track:
            out.append((track, other))
    return out


def distance_constraint(
    bones: Sequence[Bone], track: CameraTrack, other: CameraTrack, mounts: Mapping[str, Mount]
) -> DistanceConstraint | None:
    """Return the bound that the body sets on the distance between two cameras.

    Returns:
        The bound; None if the body does not bound the distance, or if the cameras were localised at the same
        time in too few frames.
    """
    constraint = reach_constraint(bones, track.bone, other.bone)
    if constraint is None:
        return None
    anchor_m, reach_m = constraint
    poses, valid = other.poses_at(track.times_ns, max_gap_ns=MAX_COARSE_GAP_NS)
    if valid.sum() < MIN_COMMON_FRAMES:
        return None
    own_poses, other_poses = track.map_from_cam[valid], poses[valid]
    cam_from_joint = invert(mounts[track.camera].joint_from_cam)
    cam_from_other = invert(mounts[other.camera].joint_from_cam)
    tip = own_poses[:, :3, :3] @ cam_from_joint[:3, 3]
    base = other_poses[:, :3, :3] @ (cam_from_other[:3, :3] @ anchor_m + cam_from_other[:3, 3])
    return DistanceConstraint(own_poses[:, :3, 3] - other_poses[:, :3, 3], tip - base, reach_m)


def reach_constraint(bones: Sequence[Bone], bone: int, other: int) -> tuple[FloatArray, float] | None:
    """Return the bound on the distance of a bone's joint from a point on another bone.

    Returns:
        The position (3,) of the point in the other bone's frame, and the maximum distance (metres). None if a
        second limb lies between the bones. The distance then depends on both limbs.
    """
    up, down = bones_to_root(bones, other), bones_to_root(bones, bone)
    shared = next(index for index in down if index in up)
    above = up[: up.index(shared)]
    if above and split_side(bones[other].role)[1] == "Arm":
        # An upper arm rotates about all axes, so its pose does not show where the trunk is.
        return None
    if any(split_side(bones[bones[index].parent].role)[1] in LIMB_CHAINS for index in above):
        return None
    anchor, reach = -np.sum([bones[index].offset_m for index in above], axis=0) + np.zeros(3), 0.0
    for index in down[: down.index(shared)]:
        parent = bones[index].parent
        if split_side(bones[parent].role)[1] in LIMB_CHAINS and parent != other:
            reach += float(np.linalg.norm(bones[index].offset_m))
        else:
            anchor += bones[index].offset_m
    return anchor, reach
