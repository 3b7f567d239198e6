"""Check of left and right: find limb cameras that stay on the wrong side of the trunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_MIN_SAMPLES = 10
"""Minimum number of frames for a judgement of a camera's side. Evidence: none."""
_SIDES = {"Right": 1.0, "Left": -1.0}
"""Sign of a limb's position along the axis to the right, by side of the body."""
_MAX_FORWARD_COSINE = 0.8
"""Maximum cosine of the angle between the trunk's forward axis and the vertical. With a larger cosine, the
trunk does not show where the body faces. Evidence: none."""
_MIN_UP_COSINE = 0.5
"""Minimum median cosine of the angle between the vertical and the trunk's up axis. The up axis follows from
the mount prior. With a smaller cosine, the prior is wrong or the person lies down. Evidence: none."""
_MIN_WRONG_RATIO = 0.8
"""Minimum fraction of frames on the wrong side for a camera whose side is swapped. Evidence:
docs/decisions/merging.md."""


def swapped_sides(
    tracks: Sequence[CameraTrack], mounts: Mapping[str, Mount], up: FloatArray
) -> dict[str, float]:
    """Find limb cameras with swapped sides, such as a left camera on the right side of the body.

    All limb cameras may stay on the wrong side. Otherwise the cameras of one part are swapped if this part
    has cameras on both sides and all of them stay on the wrong side, for example both palms. A single camera
    on the wrong side may come from the posture.

    Args:
        tracks: Tracks in one map, the track of the trunk's camera first.
        mounts: Mount prior of each camera by camera name. The prior of the trunk's camera implies where the
            body faces.
        up: (3,) vertical in the map.

    Returns:
        By camera with a swapped side, the fraction of frames on the wrong side. The result is empty if the
        first camera is on a limb or upside down, or if the person lies down, because the first camera then
        does not show where the body faces.
    """
    trunk_mount = mounts[tracks[0].camera]
    joint = tracks[0].map_from_cam[:, :3, :3] @ trunk_mount.joint_from_cam[:3, :3].T
    if split_side(trunk_mount.role)[0] or np.median(joint[:, :, 2] @ up) < _MIN_UP_COSINE:
        return {}
    out: dict[str, float] = {}
    for limb in tracks[1:]:
        side = _SIDES.get(split_side(mounts[limb.camera].role)[0], 0.0)
        trunk, valid = tracks[0].poses_at(limb.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
        forward = -trunk[:, :3, :3] @ trunk_mount.joint_from_cam[:3, :3].T[:, 1]
        valid &= np.abs(forward @ up) < _MAX_FORWARD_COSINE
        if side and valid.sum() >= _MIN_SAMPLES:
            offset = limb.map_from_cam[:, :3, 3] - trunk[:, :3, 3]
            to_the_right = (offset * np.cross(forward, up)).sum(axis=1)[valid]
            out[limb.camera] = round(float((side * to_the_right < 0.0).mean()), 3)
    wrong = {camera: share for camera, share in out.items() if share >= _MIN_WRONG_RATIO}
    if len(wrong) == len(out):
        return wrong
    parts: dict[str, list[str]] = {}
    for camera in out:
        parts.setdefault(split_side(mounts[camera].role)[1], []).append(camera)
    swapped = {
        camera
        for cameras in parts.values()
        if len({mounts[camera].role for camera in cameras}) == len(_SIDES) and wrong.keys() >= {*cameras}
        for camera in cameras
    }
    return {camera: share for camera, share in wrong.items() if camera in swapped}
