"""Relate the cameras of a rig by what their own frames gave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.relative_pose import RelativePose, estimate_relative_pose, match_instants
from bodycap_batch.model.scene import Registration
from bodycap_batch.registration.poses.observations import RigMember
from bodycap_batch.registration.tracking.klt import Tracks


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCamera:
    """A camera with its registration.

    Attributes:
        camera: The camera.
        registration: Its registration.
    """

    camera: CaptureCamera
    registration: Registration

    @property
    def tracks(self) -> Tracks:
        """The tracked observations in its frames."""
        registration = self.registration
        return Tracks(
            registration.obs_frame, registration.obs_keyframe, registration.obs_feature, registration.obs_px
        )


def estimate_relative_poses(own: RegisteredCamera, others: Sequence[RegisteredCamera]) -> list[RelativePose]:
    """Estimate the relative pose of a camera and each other one; the pair is ordered by name."""
    out = []
    for other in others:
        first, second = sorted((own, other), key=lambda each: each.camera.name)
        offset_ns = round((second.camera.offset_s - first.camera.offset_s) * 1e9)
        out.append(
            estimate_relative_pose(first.registration.trajectory, second.registration.trajectory, offset_ns)
        )
    return out


def rig_members(
    own: RegisteredCamera, others: Sequence[RegisteredCamera], relative: Sequence[RelativePose]
) -> list[RigMember]:
    """Return the camera, at the origin of the rig, and the other cameras with a well-known relative pose."""
    count = len(own.camera.times_ns)
    out = [
        RigMember(camera=own.camera, tracks=own.tracks, cam_from_rig=np.eye(4), rig_frame=np.arange(count))
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
            )
        )
    return out


def initial_rig_poses(
    own: RegisteredCamera, others: Sequence[RegisteredCamera], members: Sequence[RigMember]
) -> FloatArray:
    """Return poses rig_from_map (F,4,4) to start from; NaN if no camera has one.

    The camera's own pose is preferred to one that is derived from another camera.
    """
    out = np.full((len(own.camera.times_ns), 4, 4), np.nan)
    by_name = {item.camera.name: item.registration.trajectory for item in (own, *others)}
    for member in reversed(members):
        path = by_name[member.camera.name]
        has_pose = path.localised & (member.rig_frame >= 0)
        rig_from_cam = invert(member.cam_from_rig)
        out[member.rig_frame[has_pose]] = rig_from_cam @ invert(path.gauge_from_cam[has_pose])
    return out
