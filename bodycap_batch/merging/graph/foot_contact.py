"""Foot contacts: find the ticks at which a foot stands, and keep its ankle in place at these ticks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.model.geometry import invert, make_transform
from bodycap_batch.model.merge_data import SLIP_HUBER_SIGMAS, standing_sigma_m
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions

_HALF_WINDOW_S = 0.07
"""Half of the duration (seconds) over which an ankle's speed is computed. With this duration and 30 ticks per
second, a noise of 5 mm causes an error of 5 cm/s per axis."""
_MAX_STANDING_SPEED_M_PER_S = 0.25
"""Maximum speed (m/s) of a standing ankle. Evidence: docs/decisions/merging.md."""
_MAX_HEEL_RISE_M = 0.04
"""Maximum height (metres) of a standing ankle above its lowest position. The heel rises by more than this
height before the foot leaves the floor. Evidence: none."""
_MIN_DURATION_S = 0.1
"""Minimum duration (seconds) of a contact. Evidence: none."""
_FREE_ROTATION_SIGMA_RAD = 10.0
"""Sigma (radians) of a foot's rotation about a standing ankle. Because of this large value, the rotation is
free."""


@dataclass(frozen=True, slots=True)
class FootContact:
    """The contacts of one foot with the floor.

    Attributes:
        name: Name of the foot in the report.
        joint: Index of the ankle in the skeleton.
        bone: Index of the bone that contains the ankle; a camera is mounted on this bone.
        ankle_m: (3,) position of the ankle in the bone's frame.
        standing: (T,) whether the foot stands at each tick.
        sigma_m: Sigma per axis of the ankle's movement from one standing tick to the next, metres.
    """

    name: str
    joint: int
    bone: int
    ankle_m: FloatArray
    standing: BoolArray
    sigma_m: float

    def add(self, graph: Any, tick: int) -> None:
        """Add the factor that keeps the ankle in place from one standing tick to the next."""
        if not self.standing[tick : tick + 2].all() or tick + 1 >= len(self.standing):
            return
        # The covariance is known at the ankle. The factor needs the covariance at the origin of the bone.
        adjoint = gtsam.Pose3(make_transform(np.eye(3), self.ankle_m)).AdjointMap()
        covariance = (
            adjoint @ np.diag(np.repeat([_FREE_ROTATION_SIGMA_RAD, self.sigma_m], 3) ** 2) @ adjoint.T
        )
        noise = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Huber.Create(SLIP_HUBER_SIGMAS),
            gtsam.noiseModel.Gaussian.Covariance(covariance),
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
    """Find the ticks at which a foot stands: its measured ankle is slow and near its lowest height.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        tracks: Tracks without outliers, poses in metres.
        mounts: joint_from_cam (4,4) by camera.
        up: (3,) vertical in the frame of the tracks.
        tick_times_ns: (T,) times of the timeline's ticks.

    Returns:
        The contacts of each foot that has a camera on the shin or the foot. The tuple is empty if the
        timeline has only one tick.
    """
    if len(tick_times_ns) < 2:
        return ()
    rest, out = rest_positions(skeleton), []
    for side in ("Left", "Right"):
        ankle = skeleton.index_of_role(side + "Foot")
        # A camera on the foot is nearer to the ankle than a camera on the shin.
        for role in (side + "Foot", side + "Leg"):
            track = next((each for each in tracks if bones[each.bone].role == role), None)
            if track is None or ankle is None:
                continue
            ankle_m = rest[ankle] - rest[bones[track.bone].joint]
            poses, measured = track.poses_at(tick_times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
            centre = (poses @ invert(mounts[track.camera]) @ np.append(ankle_m, 1.0))[:, :3]
            tick_s = 1e-9 * float(np.median(np.diff(tick_times_ns)))
            standing = _contact_ticks(centre, measured, centre @ up, tick_s)
            sigma_m = standing_sigma_m(1.0 / tick_s)
            out.append(FootContact(f"{side} foot", ankle, track.bone, ankle_m, standing, sigma_m))
            break
    return tuple(out)


def _contact_ticks(centre: FloatArray, measured: BoolArray, height: FloatArray, tick_s: float) -> BoolArray:
    """Return the ticks (T,) at which an ankle stands.

    Args:
        centre: (T,3) positions of the ankle, metres.
        measured: (T,) whether a camera measured the ankle.
        height: (T,) heights of the ankle along up, metres.
        tick_s: Interval between ticks, seconds.
    """
    if not measured.any():
        return measured
    half = max(1, round(_HALF_WINDOW_S / tick_s))
    steps = np.arange(-half, half + 1)
    index = np.clip(np.arange(len(centre))[:, None] + steps, 0, len(centre) - 1)
    weight = measured[index] * (np.arange(len(centre))[:, None] + steps == index)
    # The speed is the slope of a line through the positions at the neighbouring ticks.
    count = np.maximum(weight.sum(axis=1), 1)
    away = steps - (weight * steps).sum(axis=1)[:, None] / count[:, None]
    squares = np.maximum((weight * away**2).sum(axis=1), 1e-9) * tick_s
    speed = np.linalg.norm(np.einsum("tw,twi->ti", weight * away, centre[index]), axis=1) / squares
    rest = measured & (count > half) & (speed < _MAX_STANDING_SPEED_M_PER_S)
    rest &= height < np.percentile(height[measured], 5.0) + _MAX_HEEL_RISE_M
    out = np.zeros_like(rest)
    for start, stop in runs(rest):
        # Remove the first and the last tick, at which the foot may still come down or already lift off.
        if (stop - start) * tick_s >= _MIN_DURATION_S:
            out[start + 1 : stop - 1] = True
    return np.asarray(out, dtype=np.bool_)


def contacts_in_window(
    contacts: Sequence[FootContact], tick_times_ns: IntArray, ticks: IntArray
) -> tuple[FootContact, ...]:
    """Return the contacts in a window of the timeline.

    Args:
        contacts: Contacts of each foot on the whole timeline.
        tick_times_ns: (T,) times of the timeline's ticks.
        ticks: (N,) times of the window's ticks.
    """
    first = int(np.searchsorted(tick_times_ns, ticks[0]))
    return tuple(replace(each, standing=each.standing[first : first + len(ticks)]) for each in contacts)


def contact_statistics(
    contacts: Sequence[FootContact], world_from_bone: FloatArray, fps: float
) -> dict[str, dict[str, float]]:
    """Return how often each foot stands, and how fast it slides while it stands, as plain JSON values.

    Args:
        contacts: Contacts of each foot on the whole timeline.
        world_from_bone: (T,B,4,4) solved poses of the bones.
        fps: Number of ticks per second.
    """
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
    """Return whether each joint is a standing ankle at each tick (T,J); None if `contacts` is empty.

    Args:
        contacts: Contacts of each foot on the whole timeline.
        ticks: Number T of ticks.
        joints: Number J of joints.
    """
    if not contacts:
        return None
    out = np.zeros((ticks, joints), dtype=bool)
    for each in contacts:
        out[:, each.joint] = each.standing
    return out
