"""Determine the relative poses of the cameras of a rig from the registrations of the single cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.relative_pose import RelativePose, estimate_relative_pose, match_instants
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import Registration
from bodycap_batch.registration.poses.observations import RigMember
from bodycap_batch.registration.tracking.klt import Tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCamera:
    """A camera with its registration.

    Attributes:
        camera: The camera.
        registration: The registration of this camera.
        rotation: The rotation of a camera with a rolling shutter from matches between adjacent frames; None
            if it is unknown.
    """

    camera: CaptureCamera
    registration: Registration
    rotation: RotationPath | None = None

    @property
    def tracks(self) -> Tracks:
        """The tracked observations in the frames of this camera."""
        registration = self.registration
        return Tracks(
            registration.obs_frame, registration.obs_keyframe, registration.obs_feature, registration.obs_px
        )


def estimate_relative_poses(own: RegisteredCamera, others: Sequence[RegisteredCamera]) -> list[RelativePose]:
    """Estimate the relative pose between one camera and each other camera of its rig.

    In each relative pose the two cameras are ordered by name.

    Args:
        own: The camera that belongs to every pair, with its registration.
        others: The other cameras of the rig, with their registrations.

    Returns:
        Relative poses in the order of `others`.
    """
    out = []
    for other in others:
        first, second = sorted((own, other), key=lambda each: each.camera.name)
        offset_ns = round((second.camera.clock.offset_s - first.camera.clock.offset_s) * 1e9)
        out.append(
            estimate_relative_pose(first.registration.trajectory, second.registration.trajectory, offset_ns)
        )
    return out


def rig_members(
    own: RegisteredCamera, others: Sequence[RegisteredCamera], relative: Sequence[RelativePose]
) -> list[RigMember]:
    """Return the cameras of a rig: the camera at its origin, and the cameras with a rigid relative pose.

    Args:
        own: The camera at the origin of the rig.
        others: The other cameras on the same body segment.
        relative: Relative pose between `own` and each other camera. Cameras whose relative pose is not rigid
            are excluded.
    """
    count = len(own.camera.times_ns)
    out = [
        RigMember(
            camera=own.camera,
            tracks=own.tracks,
            cam_from_rig=np.eye(4),
            rig_frame=np.arange(count),
            rotation=own.rotation,
        )
    ]
    for other, pose in zip(others, relative, strict=True):
        if not pose.is_rigid:
            continue
        own_first = pose.cameras[0] == own.camera.name
        first_from_second = pose.first_from_second
        out.append(
            RigMember(
                camera=other.camera,
                tracks=other.tracks,
                cam_from_rig=invert(first_from_second) if own_first else first_from_second,
                rig_frame=match_instants(own.camera.common_times_ns(), other.camera.common_times_ns()),
                rotation=other.rotation,
            )
        )
    return out


def initial_rig_poses(
    own: RegisteredCamera, others: Sequence[RegisteredCamera], members: Sequence[RigMember]
) -> FloatArray:
    """Return initial poses rig_from_map (F,4,4); NaN for frames in which no camera has a pose.

    The pose of the first camera is used if it is known. Otherwise the pose is derived from another camera.

    Args:
        own: The camera at the origin of the rig, with its registration.
        others: The other cameras on the same body segment, with their registrations.
        members: The cameras of the rig, from `rig_members`.
    """
    out = np.full((len(own.camera.times_ns), 4, 4), np.nan)
    by_name = {item.camera.name: item.registration.trajectory for item in (own, *others)}
    for member in reversed(members):
        path = by_name[member.camera.name]
        has_pose = path.localised & (member.rig_frame >= 0)
        rig_from_cam = invert(member.cam_from_rig)
        out[member.rig_frame[has_pose]] = rig_from_cam @ invert(path.gauge_from_cam[has_pose])
    return out
