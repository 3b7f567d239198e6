"""Find the roll of cameras about their optical axes: 0, 90, 180 or 270 degrees.

The roll is searched only if the job does not state how the camera sits on the body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import (
    MIN_COMMON_FRAMES,
    PostureHints,
    count_common_frames,
    sample_subset,
)
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
"""The rolls that are tried, degrees: the ways in which a box is strapped on."""
MIN_COST_DIFFERENCE = 8.0
"""Minimum reduction of the cost by another roll than the usual one: half the square of 4 sigma.

That people wear cameras the usual way up is known no better than this. Evidence: none.
"""
_MIN_DOWN_COSINE = 0.3
"""Mean cosine between down and the way to the limbs' cameras, above which the usual roll is accepted.

Hands that hang are 45° and more below a camera on the chest, a cosine of 0.7. If the roll is wrong, they are
beside it, and the mean is 0.
"""
_MIN_COSINE_GAIN = 0.4
"""Minimum gain of this mean cosine for another roll than the usual one. Derived as `_MIN_DOWN_COSINE`."""
_LEGS = frozenset({"UpLeg", "Leg", "Foot", "ToeBase"})
_PARTS_BELOW = {
    "Hips": _LEGS,
    "Spine": _LEGS,
    "Spine1": _LEGS | {"ForeArm", "Hand"},
    "Neck": _LEGS | {"Arm", "ForeArm", "Hand"},
    "Head": _LEGS | {"Shoulder", "Arm", "ForeArm", "Hand"},
}
"""By bone of the reference camera, the bones that are below it even if elbows are bent.

Hands at work are above the belt. Shoulders are always above a camera on the chest.
"""
_SAMPLES = 30
"""Samples of the calibration of one roll. Evidence: none."""
_ITERATIONS = 12
"""Maximum number of iterations of the calibration of one roll. Evidence: none."""


class RollCost(NamedTuple):
    """A roll, and its cost relative to the selected roll.

    Attributes:
        roll_deg: The roll.
        extra_cost: Half the sum of squares beyond that of the selected roll; negative if it is lower.
    """

    roll_deg: float
    extra_cost: float


class ReferenceRoll(NamedTuple):
    """The roll of the reference camera, and the vertical.

    Attributes:
        roll_deg: The roll.
        vertical: (3,) the vertical that the surroundings give for this roll; None if they give none.
    """

    roll_deg: float
    vertical: FloatArray | None


@dataclass(frozen=True, slots=True)
class RollSearch:
    """How well each roll of a camera explains its motion relative to the reference camera.

    Attributes:
        camera: Camera name.
        costs: Half the sum of squares for each of `ROLLS_DEG`, minus that for the usual roll.
        chosen_deg: The selected roll.
    """

    camera: str
    costs: tuple[float, ...]
    chosen_deg: float

    def runner_up(self) -> RollCost:
        """Return the best roll that was not selected."""
        chosen = self.costs[ROLLS_DEG.index(self.chosen_deg)]
        rest = [(cost - chosen, roll) for roll, cost in zip(ROLLS_DEG, self.costs, strict=True)]
        cost, roll = min(pair for pair in rest if pair[1] != self.chosen_deg)
        return RollCost(roll, cost)


def with_roll(mount: Mount, degrees: float) -> Mount:
    """Return the mount with its camera rotated about the optical axis."""
    turn = make_transform(so3_exp([0.0, 0.0, np.radians(degrees)]), np.zeros(3))
    return replace(mount, joint_from_cam=mount.joint_from_cam @ turn)


def has_unknown_roll(mount: Mount) -> bool:
    """Return True if the mount's orientation rests on the camera's name alone.

    If the job states a sigma, it also states the orientation.
    """
    return mount.by_name


def search_rolls(
    skeleton: SkeletonModel,
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    scale: float,
    hints: PostureHints,
    step: Callable[[], None],
) -> tuple[RollSearch, ...]:
    """Try all rolls of each camera on another bone than the reference camera.

    Args:
        skeleton: The body.
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks, that of the reference camera first.
        scale: Approximate scale, metres per map unit.
        hints: What is known of the posture.
        step: Called after each iteration; may raise to stop.

    Returns:
        One search per camera. Cameras with a stated orientation or with few common frames are left out.
    """
    reference = tracks[0]
    out = []
    for track in tracks[1:]:
        mount = mounts[track.camera]
        if not has_unknown_roll(mount) or mount.role == mounts[reference.camera].role:
            continue
        if count_common_frames(reference, track) < MIN_COMMON_FRAMES:
            continue
        pair = {camera: mounts[camera] for camera in (reference.camera, track.camera)}
        subset = sample_subset(skeleton, pair, (reference, track), scale, _SAMPLES, hints)
        costs = []
        for roll in ROLLS_DEG:
            priors = {**pair, track.camera: with_roll(mount, roll)}
            graph = CalibrationGraph(skeleton, subset.bones, subset.samples, priors, scale, step)
            costs.append(graph.solve(scale, iterations=_ITERATIONS))
        out.append(_select_roll(track.camera, np.array(costs)))
    return tuple(out)


def _select_roll(camera: str, costs: FloatArray) -> RollSearch:
    """Select the roll with the lowest cost (4,), if it is clearly lower than that of the usual roll."""
    relative = costs - costs[0]
    best = int(np.argmin(relative))
    chosen = ROLLS_DEG[best] if relative[best] < -MIN_COST_DIFFERENCE else 0.0
    return RollSearch(camera, tuple(relative.tolist()), chosen)


def reference_roll(
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    vertical_of: Callable[[float], FloatArray | None],
    trunk_up_of: Callable[[float], FloatArray | None] = lambda _: None,
) -> ReferenceRoll:
    """Find the roll of the reference camera from the limbs that hang below it most of the time.

    Args:
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks, that of the reference camera first.
        vertical_of: Returns for a roll in degrees the vertical (3,) of the walk or the planes that is nearest
            to the camera's own up direction with that roll, or None.
        trunk_up_of: Returns for a roll in degrees the direction (3,) in which the trunk points, or None. It
            decides on the roll if the surroundings do not, but is not used as the vertical.
    """
    reference, limbs, usual = tracks[0], _hanging_tracks(mounts, tracks), vertical_of(0.0)
    usual_cosine = 0.0 if usual is None else mean_down_cosine(reference, limbs, usual)
    is_decided = usual_cosine > _MIN_DOWN_COSINE
    if not has_unknown_roll(mounts[reference.camera]) or not limbs or is_decided:
        return ReferenceRoll(0.0, usual)
    found = [
        (mean_down_cosine(reference, limbs, up), roll, up)
        for roll in ROLLS_DEG[1:]
        if (up := vertical_of(roll)) is not None
    ]
    if usual is None and not found:
        return ReferenceRoll(_roll_from_trunk(reference, limbs, trunk_up_of), None)
    cosine, roll, vertical = max(found, key=lambda each: each[0], default=(0.0, 0.0, usual))
    if cosine > usual_cosine + _MIN_COSINE_GAIN:
        return ReferenceRoll(roll, vertical)
    return ReferenceRoll(0.0, usual)


def mean_down_cosine(reference: CameraTrack, limbs: Sequence[CameraTrack], vertical: FloatArray) -> float:
    """Return the mean cosine between down and the way from the reference camera to the limbs' cameras.

    Args:
        reference: Track of the reference camera.
        limbs: Tracks of the limbs' cameras.
        vertical: (3,) unit vector.

    Returns:
        The mean; 0 if the cameras were never measured together.
    """
    cosines = [np.zeros(0)]
    for track in limbs:
        poses, valid = track.poses_at(reference.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
        to_reference = reference.map_from_cam[valid, :3, 3] - poses[valid, :3, 3]
        distance = np.maximum(np.linalg.norm(to_reference, axis=1), 1e-12)
        cosines.append((to_reference @ vertical) / distance)
    together = np.concatenate(cosines)
    return float(together.mean()) if len(together) else 0.0


def _hanging_tracks(mounts: Mapping[str, Mount], tracks: Sequence[CameraTrack]) -> list[CameraTrack]:
    """Return the tracks of cameras on limbs below the reference camera, if both sides have one.

    One hand alone is beside the chest rather than below it.
    """
    below = _PARTS_BELOW.get(mounts[tracks[0].camera].role, frozenset())
    sides = [split_side(mounts[track.camera].role) for track in tracks]
    found = [(side, track) for (side, part), track in zip(sides, tracks, strict=True) if part in below]
    return [track for _, track in found] if {"Left", "Right"} <= {side for side, _ in found} else []


def _roll_from_trunk(
    reference: CameraTrack, limbs: Sequence[CameraTrack], trunk_up_of: Callable[[float], FloatArray | None]
) -> float:
    """Return the roll (degrees) at which limbs hang below the trunk's up direction; 0 if it is unclear."""
    cosines = {
        roll: mean_down_cosine(reference, limbs, up)
        for roll in ROLLS_DEG
        if (up := trunk_up_of(roll)) is not None
    }
    if not cosines:
        return 0.0
    best = max(cosines, key=lambda roll: cosines[roll])
    is_clear = cosines[best] > max(_MIN_COSINE_GAIN, cosines.get(0.0, 0.0) + _MIN_COSINE_GAIN)
    return best if is_clear else 0.0
