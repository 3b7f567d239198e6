"""Are left and right what the cameras' names say? Limbs seen on the other side of the trunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_MIN_SAMPLES = 10
_SIDES = {"Right": 1.0, "Left": -1.0}
_MAX_FORWARD_COSINE = 0.8
"""Share along the vertical of what is ahead of a trunk up to which it tells the way the body faces."""
_MIN_UP_COSINE = 0.5
"""Cosine between the vertical and the trunk, as its camera is said to sit on it, from which both agree."""
_MIN_WRONG_RATIO = 0.8
"""On 12 captures (walks, kitchen work, arms thrown about, bending and lifting) each of 24 limbs' cameras was
on its own side of the chest's at 90 % of the times and more."""


def swapped_sides(
    tracks: Sequence[CameraTrack], mounts: Mapping[str, Mount], up: FloatArray
) -> dict[str, float]:
    """Cameras of limbs that stay on the other side of the body, if all of them do.

    Args:
        tracks: Paths in one map, the trunk's first.
        mounts: By camera, how it is said to sit on the body: what is ahead of the trunk follows from that.
        up: (3,) the vertical in the map.

    Returns:
        By camera the share of the time it is on the wrong side; nothing where one limb is where it belongs,
        or where the first camera does not tell: it rides on a limb, on a trunk that lies, or on its head.
    """
    worn = mounts[tracks[0].camera]
    joint = tracks[0].map_from_cam[:, :3, :3] @ worn.joint_from_cam[:3, :3].T
    if split_side(worn.role)[0] or np.median(joint[:, :, 2] @ up) < _MIN_UP_COSINE:
        return {}
    out: dict[str, float] = {}
    for limb in tracks[1:]:
        side = _SIDES.get(split_side(mounts[limb.camera].role)[0], 0.0)
        trunk, known = tracks[0].poses_at(limb.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
        ahead = -trunk[:, :3, :3] @ worn.joint_from_cam[:3, :3].T[:, 1]
        known &= np.abs(ahead @ up) < _MAX_FORWARD_COSINE
        if side and known.sum() >= _MIN_SAMPLES:
            away = limb.map_from_cam[:, :3, 3] - trunk[:, :3, 3]
            to_the_right = (away * np.cross(ahead, up)).sum(axis=1)[known]
            out[limb.camera] = round(float((side * to_the_right < 0.0).mean()), 3)
    return out if out and min(out.values()) >= _MIN_WRONG_RATIO else {}
