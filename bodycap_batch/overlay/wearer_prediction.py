"""Predict where the wearer's body is in the pictures of a camera, from the solved motion."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, poses_at
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.model.wearer_view import WearerView
from bodycap_batch.overlay.bone_motion import BoneMotion, bones_from_motion

_RADII_M = {
    "Hips": (0.15, 0.14),
    "Spine": (0.14, 0.14),
    "Spine1": (0.15, 0.11),
    "Neck": (0.06, 0.06),
    "Head": (0.09, 0.09),
    "Shoulder": (0.06, 0.06),
    "Arm": (0.055, 0.045),
    "ForeArm": (0.045, 0.03),
    "Hand": (0.04, 0.03),
    "UpLeg": (0.09, 0.06),
    "Leg": (0.06, 0.035),
    "Foot": (0.045, 0.04),
    "ToeBase": (0.04, 0.03),
}
"""Radii (metres) of the capsule at the start and at the end of a bone. The key is the body part of the joint
that rotates the bone. Origin: circumferences of an adult (upper arm 0.30, forearm 0.27, wrist 0.17, thigh
0.56, calf 0.38, ankle 0.23, head 0.57 metres) divided by 2π, and half breadths of the trunk. Evidence:
none."""
_SIDE_BRANCH_M = 0.08
"""Radius (metres) of the capsule from a joint of the trunk to a joint of a limb. Evidence: none."""
_UNMEASURED_SIGMA_M = 0.02
"""Standard deviation (metres) of the position of a joint that no camera measured. Evidence: none."""
_SIGMAS = 1.0
"""Number of standard deviations of the joints' positions by which each capsule is dilated. Evidence: none."""
_MAX_MARGIN_M = 0.02
"""Maximum dilation of a capsule, metres. A body whose position is less certain than that would hide a large
part of the room. Evidence: none."""
_LENS_CLEARANCE_M = 0.01
"""Minimum distance (metres) of the lens from the surface of a capsule. Nearer capsules are made thinner,
because the lens is outside the body. Evidence: none."""
_MAX_TICKS = 2.0
"""Maximum distance (ticks) of two ticks between which the pose of the body is interpolated."""
_TINY = 1e-12
"""Smallest divisor, for bones without length."""


def predict_wearer_view(
    merge: MergeResult, camera: str, lens: Camera, common_ns: IntArray, poses: FloatArray
) -> WearerView:
    """Return the capsules of the body as one camera sees them.

    Args:
        merge: The solved body, with or without filled joints.
        camera: Camera name. The camera must have a solved mount.
        lens: Intrinsics of the camera, at the work size.
        common_ns: (N,) common time of each frame, nanoseconds.
        poses: (N,4,4) measured poses world_from_cam, metres; NaN for a lost frame.
    """
    motion, bones = merge.motion, bones_from_motion(merge.motion)
    mount = next(mount for mount in merge.mounts if mount.camera == camera)
    own = motion.skeleton.index_of_role(mount.role)
    assert own is not None  # Merging refuses a mount on a missing joint.
    world_from_mount = motion.world_from_joint()[:, own] @ mount.joint_from_cam
    tick_ns = int(_MAX_TICKS * 1e9 / motion.fps)
    predicted, inside = poses_at(bones.times_ns, world_from_mount, common_ns, max_gap_ns=tick_ns)
    measured = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    world_from_cam = np.where(measured[:, None, None], poses, predicted)
    world_from_cam[np.asarray(~(measured | inside))] = np.nan
    before, weight = _tick_weights(bones.times_ns, common_ns)
    after = np.minimum(before + 1, len(bones.times_ns) - 1)
    ends, mixed = bones.ends_in_world, weight[:, None, None, None]
    in_world = (1.0 - mixed) * ends[before] + mixed * ends[after]
    in_cam = np.full_like(in_world, np.nan)
    cam_from_world = invert(world_from_cam[inside])
    rotated = np.einsum("nij,nbej->nbei", cam_from_world[:, :3, :3], in_world[inside])
    in_cam[inside] = rotated + cam_from_world[:, None, None, :3, 3]
    sigma = np.nan_to_num(merge.joint_sigma_m(), nan=_UNMEASURED_SIGMA_M)[before][:, bones.joints]
    margin = np.minimum(_SIGMAS * sigma, _MAX_MARGIN_M)
    room = np.nan_to_num(np.maximum(_distance_of_lens(in_cam) - _LENS_CLEARANCE_M, 0.0))
    radius = np.minimum(_bone_radii(bones, motion.skeleton) + margin[..., None], room[..., None])
    radius[:, bones.joints == own] = 0.0
    return WearerView(
        camera=camera, lens=lens, world_from_cam=world_from_cam, ends_in_cam_m=in_cam, radius_m=radius
    )


def _bone_radii(bones: BoneMotion, skeleton: SkeletonModel) -> FloatArray:
    """Return the radius (B,2) of each bone's capsule at start and end, metres, without dilation."""
    radii = []
    for joint, side in zip(bones.joints.tolist(), bones.sides, strict=True):
        own_side, part = split_side(skeleton.roles[joint])
        branches_off = side and not own_side
        radii.append((_SIDE_BRANCH_M,) * 2 if branches_off else _RADII_M.get(part, (_SIDE_BRANCH_M,) * 2))
    return np.array(radii, dtype=np.float64).reshape(-1, 2)


def _tick_weights(ticks_ns: IntArray, at_ns: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the index (N,) of the tick before each time, and the weight (N,) of the tick after it."""
    before = np.clip(np.searchsorted(ticks_ns, at_ns, side="right") - 1, 0, max(len(ticks_ns) - 2, 0))
    after = np.minimum(before + 1, len(ticks_ns) - 1)
    share = (at_ns - ticks_ns[before]) / np.maximum(ticks_ns[after] - ticks_ns[before], 1)
    return np.asarray(before), np.asarray(np.clip(share, 0.0, 1.0))


def _distance_of_lens(ends_in_cam: FloatArray) -> FloatArray:
    """Return the distance (N,B) of the camera centre from each bone, for ends (N,B,2,3) in its frame."""
    start, bone = ends_in_cam[..., 0, :], ends_in_cam[..., 1, :] - ends_in_cam[..., 0, :]
    length2 = np.maximum((bone**2).sum(axis=-1), _TINY)
    share = np.clip(-(start * bone).sum(axis=-1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(start + share[..., None] * bone, axis=-1))
