"""Predict where the wearer's body is in the pictures of a camera, from the solved motion.

Each bone is surrounded by a capsule: a cone with rounded ends. A pixel shows the body if its viewing ray hits
a capsule. The rays follow from the camera model, so that lens distortion is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, poses_at
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side
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
_GRID = (24, 18)
"""Number of columns and rows of viewing rays with which the share of the body in a picture is measured."""
_MAX_TICKS = 2.0
"""Maximum distance (ticks) of two ticks between which the pose of the body is interpolated."""
_TINY = 1e-12
"""Smallest divisor, for bones without length and rays along a bone."""
_BLOCK_RAYS = 20_000
"""Maximum number of rays that are tested at a time. It limits the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WearerView:
    """The capsules of the wearer's body as one camera sees them.

    Attributes:
        camera: Camera name.
        lens: Intrinsics of the camera, at the work size (the image size that all stages work at).
        world_from_cam: (N,4,4) predicted pose of each frame in the world, metres; NaN if it is unknown. It is
            the measured pose of a localised frame, and follows from the solved body for other frames.
        ends_in_cam_m: (N,B,2,3) start and end of each bone in the camera frame, metres; NaN if unknown.
        radius_m: (N,B,2) radius of each capsule at start and end, metres, with its dilation; 0 for the bone
            that carries the camera.
    """

    camera: str
    lens: Camera
    world_from_cam: FloatArray
    ends_in_cam_m: FloatArray
    radius_m: FloatArray

    def __post_init__(self) -> None:
        frames, bones = np.shape(self.radius_m)[:2]
        set_array(self, "world_from_cam", (frames, 4, 4), finite=False)
        set_array(self, "ends_in_cam_m", (frames, bones, 2, 3), finite=False)
        set_array(self, "radius_m", (frames, bones, 2))

    @property
    def is_known(self) -> BoolArray:
        """Mask (N,) of the frames in which the place of the body is known."""
        return np.asarray(np.isfinite(self.ends_in_cam_m).all(axis=(1, 2, 3)))

    def covers(self, px: FloatArray, frame: IntArray) -> BoolArray:
        """Return a mask (M,) of the pixels that show the body; False in a frame where its place is unknown.

        Args:
            px: (M,2) pixels at the work size.
            frame: (M,) frame index of each pixel.
        """
        return np.isfinite(self.depth_along_ray(self.lens.unproject(px), frame))

    def depth_along_ray(self, rays: FloatArray, frame: IntArray) -> FloatArray:
        """Return the distance (M,) of the body from the camera along each ray, metres; infinity without body.

        The distance is that of the point on the ray that is nearest to the bone.

        Args:
            rays: (M,2) viewing rays: x and y at depth 1.
            frame: (M,) frame index of each ray.
        """
        out = np.full(len(rays), np.inf)
        for first in range(0, len(rays), _BLOCK_RAYS):
            part = slice(first, first + _BLOCK_RAYS)
            directions = np.column_stack([rays[part], np.ones(len(rays[part]))])
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            distance, along, share = _nearest_on_bones(directions, self.ends_in_cam_m[frame[part]])
            radius = self.radius_m[frame[part]]
            limit = (1.0 - share) * radius[..., 0] + share * radius[..., 1]
            # Comparisons with NaN are False: a frame without a known body has no body.
            hit = (distance < limit) & (along > 0.0)
            out[part] = np.where(hit, along, np.inf).min(axis=1, initial=np.inf)
        return out

    def share(self) -> FloatArray:
        """Return the share (N,) of each picture that the body covers, 0 to 1; NaN if it is unknown."""
        columns, rows = _GRID
        x = (np.arange(columns) + 0.5) / columns * self.lens.width_px
        y = (np.arange(rows) + 0.5) / rows * self.lens.height_px
        rays = self.lens.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        rays = rays[np.isfinite(rays).all(axis=1)]
        known = np.flatnonzero(self.is_known)
        depth = self.depth_along_ray(np.tile(rays, (len(known), 1)), np.repeat(known, len(rays)))
        out = np.full(len(self.radius_m), np.nan)
        out[known] = np.isfinite(depth).reshape(len(known), len(rays)).mean(axis=1)
        return out


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


def _nearest_on_bones(directions: FloatArray, ends: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find where rays from the camera centre come nearest to bones.

    Args:
        directions: (M,3) directions of the rays, of length 1.
        ends: (M,B,2,3) start and end of each bone for each ray.

    Returns:
        The distance (M,B) between ray and bone, the position (M,B) of the nearest point along the ray, and
        its position (M,B) along the bone, 0 at the start and 1 at the end.
    """
    start, bone = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    ray = directions[:, None, :]
    bone_bone = np.maximum((bone**2).sum(axis=-1), _TINY)
    ray_bone, ray_start = (ray * bone).sum(axis=-1), (ray * start).sum(axis=-1)
    bone_start = (bone * start).sum(axis=-1)
    across = np.maximum(bone_bone - ray_bone**2, _TINY)
    share = np.clip((ray_bone * ray_start - bone_start) / across, 0.0, 1.0)
    along = ray_start + share * ray_bone
    # If the nearest point is behind the camera, the ray starts at its nearest point.
    behind = along < 0.0
    share = np.where(behind, np.clip(-bone_start / bone_bone, 0.0, 1.0), share)
    along = np.maximum(along, 0.0)
    gap = start + share[..., None] * bone - along[..., None] * ray
    return np.linalg.norm(gap, axis=-1), along, share
