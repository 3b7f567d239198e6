"""Are left and right what the cameras' names say? Limbs seen on the other side of the trunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.merging.tracks import SAMPLE_REACH_NS, Track

_FEWEST = 10
_LEVEL = 0.8
"""Share of the line of sight along the vertical up to which a trunk's camera tells the way the body faces."""
_UPRIGHT = 0.5
"""Cosine between the picture's upper edge and the vertical from which both agree on what is up."""
_WRONG = 0.8
"""On 12 captures (walks, kitchen work, arms thrown about, bending and lifting) each of 24 limbs' cameras was
on its own side of the chest's at 90 % of the times and more."""


def exchanged_sides(tracks: Sequence[Track], roles: Mapping[str, str], up: FloatArray) -> dict[str, float]:
    """Cameras of limbs that stay on the other side of the body, if all of them do.

    Args:
        tracks: Paths in one map, the trunk's first.
        roles: By camera, what it rides on.
        up: (3,) the vertical in the map.

    Returns:
        By camera the share of the time it is on the wrong side; nothing where one limb is where it belongs,
        or where the trunk's camera does not tell: it looks up or down, or is mounted on its head.
    """
    poses = tracks[0].map_from_cam
    if np.median(-poses[:, :3, 1] @ up) < _UPRIGHT:
        return {}
    out: dict[str, float] = {}
    for limb in tracks[1:]:
        role = roles[limb.camera]
        side = float(role.startswith("Right")) - float(role.startswith("Left"))
        trunk, known = tracks[0].at(limb.times_ns, reach_ns=SAMPLE_REACH_NS)
        ahead = trunk[:, :3, 2]
        known &= np.abs(ahead @ up) < _LEVEL
        if side and known.sum() >= _FEWEST:
            away = limb.map_from_cam[:, :3, 3] - trunk[:, :3, 3]
            to_the_right = (away * np.cross(ahead, up)).sum(axis=1)[known]
            out[limb.camera] = round(float((side * to_the_right < 0.0).mean()), 3)
    return out if out and min(out.values()) >= _WRONG else {}
