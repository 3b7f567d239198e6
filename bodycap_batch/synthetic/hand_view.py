"""Mount of a camera on a forearm that sees the hand of the same arm in a given share of its picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions, segment_axes
from bodycap_batch.synthetic.lens import ray_grid
from bodycap_batch.synthetic.raycast import NOTHING, RayScene
from bodycap_batch.synthetic.wearer import Wearer

_PLACE = 0.72
"""Position of the camera along the forearm, as a fraction of its length."""
_OFF_M = 0.065
"""Distance (metres) of the camera from the bone of the forearm."""
_MAX_DOWN_DEG = 75.0
"""Largest angle (degrees) between the bone and the viewing direction, which points down to the hand."""
_STEPS = 24
"""Number of angles that are tried."""
_RAY_STEP = 4
"""Every ray with this distance (px) along rows and columns is cast to measure the share."""


def with_hand_in_view(mount: Mount, skeleton: SkeletonModel, camera: Camera, share: float) -> Mount:
    """Return the mount of a camera, turned so that hand and forearm fill about a share of its picture.

    The camera is on the thumb's side of the forearm and looks along the bone, and down to the hand by an
    angle that is found by trying. Mounts on other bones stay.

    Args:
        mount: True mount, as it was drawn.
        skeleton: Skeleton with the true proportions.
        camera: Intrinsics of the camera.
        share: Share of the picture, 0 to 1.
    """
    if not mount.role.endswith("ForeArm"):
        return mount
    hand = skeleton.index_of_role(mount.role.replace("ForeArm", "Hand"))
    bone = np.asarray(skeleton.offsets_m[hand])
    axes = segment_axes(skeleton, mount.role)
    along, forward = axes[:, 0], axes[:, 1]
    # The posture at rest of the skeleton, in which the frames of all joints are parallel.
    joints = np.tile(np.eye(4), (len(skeleton.joints), 1, 1))
    elbow = skeleton.index_of_role(mount.role)
    joints[:, :3, 3] = rest_positions(skeleton) - rest_positions(skeleton)[elbow]
    wearer = Wearer(skeleton, np.random.SeedSequence(0))
    parts = wearer.parts(np.zeros((len(wearer.images), 2)))
    limbs = [
        RayScene(shape.vertices + joints[joint, :3, 3], shape.faces)
        for joint, shape in parts
        if joint in (hand, elbow)
    ]
    rays = ray_grid(camera).in_cam[::_RAY_STEP, ::_RAY_STEP].reshape(-1, 3)
    centre = _PLACE * bone + _OFF_M * forward
    found, least = mount.joint_from_cam, np.inf
    for down_deg in np.linspace(0.0, _MAX_DOWN_DEG, _STEPS):
        pose = _looking_at_hand(along, forward, centre, float(down_deg))
        turned = rays @ pose[:3, :3].T
        origins = np.broadcast_to(pose[:3, 3], turned.shape)
        cast = np.concatenate([origins, turned], axis=1).astype(np.float32)
        seen = np.any([limb.first_hit(cast)[0] != NOTHING for limb in limbs], axis=0)
        if abs(seen.mean() - share) < least:
            found, least = pose, abs(float(seen.mean()) - share)
    return replace(mount, joint_from_cam=found)


def _looking_at_hand(
    along: FloatArray, forward: FloatArray, centre: FloatArray, down_deg: float
) -> FloatArray:
    """Return the pose (4,4) of a camera that looks along a bone and down to it by an angle."""
    angle = np.radians(down_deg)
    view = np.cos(angle) * along - np.sin(angle) * forward
    down = -np.sin(angle) * along - np.cos(angle) * forward
    return make_transform(np.stack([np.cross(down, view), down, view], axis=1), centre)
