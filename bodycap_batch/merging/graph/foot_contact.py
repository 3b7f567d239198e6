"""Feet that stand do not slide: where a leg's camera shows the ankle at rest near the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.model.geometry import invert, make_transform
from bodycap_batch.model.merge_data import standing_sigma_m
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions

_HALF_WINDOW_S = 0.07
"""Half of the time over which an ankle's speed is taken: 5 mm of noise are 5 cm/s an axis at 30 Hz."""
_MAX_STANDING_SPEED_M_PER_S = 0.25
"""Standing ankles of recorded walks (CMU 12_01, 131_03) move at 0.02 to 0.1 m/s, swinging ones at 1 to 3."""
_MAX_HEEL_RISE_M = 0.04
"""The heel rises by more than this before the foot leaves the floor."""
_MIN_DURATION_S = 0.1
_FREE_ROTATION_SIGMA_RAD = 10.0


@dataclass(frozen=True, slots=True)
class FootContact:
    """An ankle, and when its foot stands.

    Attributes:
        name: For the report.
        joint: The ankle in the skeleton.
        bone: Index of the bone that carries it.
        ankle_m: (3,) the ankle in that bone's frame.
        standing: (T,) at ticks.
        sigma_m: How far the ankle moves from one standing tick to the next.
    """

    name: str
    joint: int
    bone: int
    ankle_m: FloatArray
    standing: BoolArray
    sigma_m: float

    def add(self, graph: Any, tick: int) -> None:
        """Hold the ankle from a standing tick to the next one, too."""
        if not self.standing[tick : tick + 2].all() or tick + 1 >= len(self.standing):
            return
        # The ankle's own motion is the bone's, seen from the ankle: its covariance carried to the joint.
        adjoint = gtsam.Pose3(make_transform(np.eye(3), self.ankle_m)).AdjointMap()
        covariance = (
            adjoint @ np.diag(np.repeat([_FREE_ROTATION_SIGMA_RAD, self.sigma_m], 3) ** 2) @ adjoint.T
        )
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(2.0), gtsam.noiseModel.Gaussian.Covariance(covariance)
        )
        keys = bone_key(tick, self.bone), bone_key(tick + 1, self.bone)
        graph.add(gtsam.BetweenFactorPose3(*keys, gtsam.Pose3(), noise))


def find_contacts(
    skeleton: SkeletonModel,
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    mounts: Mapping[str, FloatArray],
    up: FloatArray,
    tick_times_ns: IntArray,
) -> tuple[FootContact, ...]:
    """Find when feet stand: the measured ankle is slow, and about as low as it ever gets.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        tracks: Cleaned tracks, poses in metres.
        mounts: joint_from_cam (4,4) by camera.
        up: (3,) the vertical of the tracks' frame.
        tick_times_ns: (T,) the timeline.

    Returns:
        One for each foot whose shin or foot carries a camera; none on a timeline of one tick.
    """
    if len(tick_times_ns) < 2:
        return ()
    rest, out = rest_positions(skeleton), []
    for side in ("Left", "Right"):
        ankle = skeleton.index_of_role(side + "Foot")
        # A camera on the foot itself knows best.
        for role in (side + "Foot", side + "Leg"):
            track = next((each for each in tracks if bones[each.bone].role == role), None)
            if track is None or ankle is None:
                continue
            ankle_m = rest[ankle] - rest[bones[track.bone].joint]
            poses, seen = track.poses_at(tick_times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
            centre = (poses @ invert(mounts[track.camera]) @ np.append(ankle_m, 1.0))[:, :3]
            tick_s = 1e-9 * float(np.median(np.diff(tick_times_ns)))
            standing = _contact_ticks(centre, seen, centre @ up, tick_s)
            sigma_m = standing_sigma_m(1.0 / tick_s)
            out.append(FootContact(f"{side} foot", ankle, track.bone, ankle_m, standing, sigma_m))
            break
    return tuple(out)


def _contact_ticks(centre: FloatArray, seen: BoolArray, height: FloatArray, tick_s: float) -> BoolArray:
    """Ticks (T,) at which an ankle (T,3) stands."""
    if not seen.any():
        return seen
    half = max(1, round(_HALF_WINDOW_S / tick_s))
    steps = np.arange(-half, half + 1)
    index = np.clip(np.arange(len(centre))[:, None] + steps, 0, len(centre) - 1)
    weight = seen[index] * (np.arange(len(centre))[:, None] + steps == index)
    # Slope of a line through the ticks around.
    count = np.maximum(weight.sum(axis=1), 1)
    away = steps - (weight * steps).sum(axis=1)[:, None] / count[:, None]
    squares = np.maximum((weight * away**2).sum(axis=1), 1e-9) * tick_s
    speed = np.linalg.norm(np.einsum("tw,twi->ti", weight * away, centre[index]), axis=1) / squares
    rest = seen & (count > half) & (speed < _MAX_STANDING_SPEED_M_PER_S)
    rest &= height < np.percentile(height[seen], 5.0) + _MAX_HEEL_RISE_M
    out = np.zeros_like(rest)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rest.astype(np.int8), [0]])))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        # At its ends the foot comes down or peels off.
        if (end - first) * tick_s >= _MIN_DURATION_S:
            out[first + 1 : end - 1] = True
    return np.asarray(out, dtype=np.bool_)


def contacts_in_window(
    contacts: Sequence[FootContact], tick_times_ns: IntArray, ticks: IntArray
) -> tuple[FootContact, ...]:
    """The contacts of a stretch of the timeline (T,), given as its own ticks."""
    first = int(np.searchsorted(tick_times_ns, ticks[0]))
    return tuple(replace(each, standing=each.standing[first : first + len(ticks)]) for each in contacts)


def contact_statistics(
    contacts: Sequence[FootContact], world_from_bone: FloatArray, fps: float
) -> dict[str, dict[str, float]]:
    """How often each foot stood, and how fast it slides in solved poses (T,B,4,4) meanwhile, m/s."""
    out = {}
    for each in contacts:
        out[each.name] = {"standing_share": round(float(each.standing.mean()), 4)}
        held = each.standing[1:] & each.standing[:-1]
        if held.any():
            ankle = (world_from_bone[:, each.bone] @ np.append(each.ankle_m, 1.0))[:, :3]
            speed = fps * np.linalg.norm(np.diff(ankle, axis=0), axis=1)[held]
            figures = {f"slide_p{q}_m_per_s": round(float(np.percentile(speed, q)), 4) for q in (50, 95)}
            out[each.name] |= figures
    return out


def standing_joints(contacts: Sequence[FootContact], ticks: int, joints: int) -> BoolArray | None:
    """(T,J) where an ankle's foot stands; None where no foot can be seen to."""
    if not contacts:
        return None
    out = np.zeros((ticks, joints), dtype=bool)
    for each in contacts:
        out[:, each.joint] = each.standing
    return out
