"""Find the roll of cameras about their optical axes: 0, 90, 180 or 270 degrees.

The roll is searched only if the job does not give the camera's orientation on the body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import PostureHints, take_samples
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
"""The rolls that are tried, degrees: the four ways to strap a box-shaped camera on. The usual roll is 0°."""
MIN_COST_DIFFERENCE = 8.0
"""Minimum reduction of the cost to select a roll other than the usual roll. Evidence: none.

The cost is half the sum of squared residuals, so a residual of 4 sigma has the cost 8. The threshold is high
because most people wear their cameras with the usual roll.
"""
_MIN_DOWN_COSINE = 0.3
"""Minimum mean cosine at which the usual roll is accepted, see `mean_down_cosine`. Unit: 1.

The angles are between the downward direction and the directions to the limbs' cameras. Seen from a camera on
the chest, hanging hands are 45° or more below the horizontal, which gives a cosine of 0.7. If the roll is
wrong by 90°, the hands seem to be beside the camera, and the mean cosine is 0.
"""
_MIN_COSINE_GAIN = 0.4
"""Minimum increase of the mean cosine to select a roll other than the usual roll. Unit: 1.

The mean cosine is the result of `mean_down_cosine`. The correct roll has a mean cosine of about 0.7. A roll
that is wrong by 90° has a mean cosine of 0. Derivation: see `_MIN_DOWN_COSINE`.
"""
_LEGS = frozenset({"UpLeg", "Leg", "Foot", "ToeBase"})
_PARTS_BELOW = {
    "Hips": _LEGS,
    "Spine": _LEGS,
    "Spine1": _LEGS | {"ForeArm", "Hand"},
    "Neck": _LEGS | {"Arm", "ForeArm", "Hand"},
    "Head": _LEGS | {"Shoulder", "Arm", "ForeArm", "Hand"},
}
"""By bone of the reference camera, the body parts that are below this camera even if the elbows are bent.

Working hands are above the belt, so a camera on the hips or the lower spine has only the legs below it.
Shoulders are always above a camera on the chest.
"""
_MIN_COMMON_FRAMES = 15
"""Minimum number of common frames of a camera and the reference camera: half a second at 30 fps. The search
skips a camera with fewer. Evidence: none."""
_SAMPLES = 30
"""Maximum number of sampled times in the calibration of one roll. Evidence: none."""
_ITERATIONS = 12
"""Maximum number of optimiser iterations in the calibration of one roll. Evidence: none."""


@dataclass(frozen=True, slots=True)
class RollSearch:
    """The result of the roll search for one camera: the cost of each roll, and the selected roll.

    A low cost means that the roll explains the camera's motion relative to the reference camera well.

    Attributes:
        camera: Camera name.
        costs: For each roll of `ROLLS_DEG`, its cost minus the cost of the usual roll. The cost is half the
            sum of the squared residuals.
        chosen_deg: The selected roll, degrees.
    """

    camera: str
    costs: tuple[float, ...]
    chosen_deg: float

    def runner_up(self) -> tuple[float, float]:
        """Return the best of the other rolls (degrees), and its cost minus that of the selected roll."""
        chosen = self.costs[ROLLS_DEG.index(self.chosen_deg)]
        rest = [(cost - chosen, roll) for roll, cost in zip(ROLLS_DEG, self.costs, strict=True)]
        cost, roll = min(pair for pair in rest if pair[1] != self.chosen_deg)
        return roll, cost


def with_roll(mount: Mount, degrees: float) -> Mount:
    """Return the mount with its camera rotated about the optical axis by an angle in degrees."""
    turn = make_transform(so3_exp([0.0, 0.0, np.radians(degrees)]), np.zeros(3))
    return replace(mount, joint_from_cam=mount.joint_from_cam @ turn)


def has_unknown_roll(mount: Mount) -> bool:
    """Return True if the job does not give the mount's orientation.

    The orientation is then assumed from the camera's name only. A sigma given in the job shows that the job
    also gives the orientation.
    """
    return mount.by_name


def roll_deg(prior: Mount, solved: Mount) -> float:
    """Return the roll of a solved mount relative to its prior: degrees about the optical axis.

    The result is between −180 and 180.
    """
    rotation = prior.joint_from_cam[:3, :3].T @ solved.joint_from_cam[:3, :3]
    return float(np.degrees(np.arctan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])))


def search_rolls(
    skeleton: SkeletonModel,
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    scale: float,
    hints: PostureHints,
    step: Callable[[], None],
) -> tuple[RollSearch, ...]:
    """Try all rolls of each camera that is mounted on another bone than the reference camera.

    Args:
        skeleton: The skeleton of the body.
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks. The track of the reference camera is the first.
        scale: Approximate scale, metres per map unit.
        hints: Facts about the posture that are known before the calibration.
        step: Function that is called after each iteration. It may raise an exception to stop the work.

    Returns:
        One search per camera. The result does not contain cameras whose orientation the job gives, or cameras
        that share too few frames with the reference camera.
    """
    reference = tracks[0]
    out = []
    for track in tracks[1:]:
        mount = mounts[track.camera]
        if not has_unknown_roll(mount) or mount.role == mounts[reference.camera].role:
            continue
        if track.poses_at(reference.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1].sum() < _MIN_COMMON_FRAMES:
            continue
        roles = [mounts[each.camera].role for each in (reference, track)]
        bones = kinematic_chain(skeleton, roles)
        index = {bone.role: number for number, bone in enumerate(bones)}
        pair = [replace(each, bone=index[role]) for each, role in zip((reference, track), roles, strict=True)]
        samples = take_samples(pair, scale, _SAMPLES, hints.vertical, hints.t_pose_ns)
        costs = []
        for roll in ROLLS_DEG:
            priors = {**mounts, track.camera: with_roll(mount, roll)}
            graph = CalibrationGraph(skeleton, bones, samples, priors, scale, step)
            costs.append(graph.solve(scale, iterations=_ITERATIONS))
        out.append(_select_roll(track.camera, np.array(costs)))
    return tuple(out)


def _select_roll(camera: str, costs: FloatArray) -> RollSearch:
    """Select the roll with the lowest cost, if this cost is clearly lower than the cost of the usual roll.

    Args:
        camera: Camera name.
        costs: (4,) cost of each roll of `ROLLS_DEG`.

    Returns:
        The search result. It selects the usual roll if no other roll is clearly better.
    """
    relative = costs - costs[0]
    best = int(np.argmin(relative))
    chosen = ROLLS_DEG[best] if relative[best] < -MIN_COST_DIFFERENCE else 0.0
    return RollSearch(camera, tuple(relative.tolist()), chosen)


def reference_roll(
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    vertical_of: Callable[[float], FloatArray | None],
    trunk_up_of: Callable[[float], FloatArray | None] = lambda _: None,
) -> float:
    """Find the roll of the reference camera from the limbs that hang below it most of the time.

    Args:
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks. The track of the reference camera is the first.
        vertical_of: Function that takes a roll in degrees and returns the vertical (3,) or None. The vertical
            comes from the job, the map or the walk. If several directions are possible, the function selects
            the direction that best fits the up direction of the camera with this roll.
        trunk_up_of: Function that takes a roll in degrees and returns the up direction of the trunk (3,) or
            None. This direction is used only if `vertical_of` returns None for all rolls.

    Returns:
        The roll, degrees. It is 0 if the job gives the orientation of the reference camera, if
        no limbs hang below the camera, or if no other roll is clearly better.
    """
    reference, limbs, usual = tracks[0], hanging_tracks(mounts, tracks), vertical_of(0.0)
    usual_cosine = 0.0 if usual is None else mean_down_cosine(reference, limbs, usual)
    is_decided = usual_cosine > _MIN_DOWN_COSINE
    if not has_unknown_roll(mounts[reference.camera]) or not limbs or is_decided:
        return 0.0
    cosines = {
        roll: mean_down_cosine(reference, limbs, up)
        for roll in ROLLS_DEG[1:]
        if (up := vertical_of(roll)) is not None
    }
    if usual is None and not cosines:
        return _roll_from_trunk(reference, limbs, trunk_up_of)
    best = max(cosines, key=lambda roll: cosines[roll], default=0.0)
    return best if cosines.get(best, 0.0) > usual_cosine + _MIN_COSINE_GAIN else 0.0


def mean_down_cosine(reference: CameraTrack, limbs: Sequence[CameraTrack], vertical: FloatArray) -> float:
    """Return the mean cosine between the downward direction and the directions to the limbs' cameras.

    The directions start at the reference camera.

    Args:
        reference: Track of the reference camera.
        limbs: Tracks of the limbs' cameras.
        vertical: (3,) unit vector upwards, in the gauge of the tracks.

    Returns:
        The mean cosine; 0 if the reference camera and the limbs' cameras were never measured together.
    """
    cosines = [np.zeros(0)]
    for track in limbs:
        poses, valid = track.poses_at(reference.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
        to_reference = reference.map_from_cam[valid, :3, 3] - poses[valid, :3, 3]
        distance = np.maximum(np.linalg.norm(to_reference, axis=1), 1e-12)
        cosines.append((to_reference @ vertical) / distance)
    together = np.concatenate(cosines)
    return float(together.mean()) if len(together) else 0.0


def hanging_tracks(mounts: Mapping[str, Mount], tracks: Sequence[CameraTrack]) -> list[CameraTrack]:
    """Return the tracks of the cameras on limbs that hang below the reference camera.

    The list is empty if only one side of the body has such cameras. Seen from the chest, the hand of one side
    is to the left or right rather than below. Hands of both sides are below on average.
    """
    below = _PARTS_BELOW.get(mounts[tracks[0].camera].role, frozenset())
    sides = [split_side(mounts[track.camera].role) for track in tracks]
    found = [(side, track) for (side, part), track in zip(sides, tracks, strict=True) if part in below]
    return [track for _, track in found] if {"Left", "Right"} <= {side for side, _ in found} else []


def _roll_from_trunk(
    reference: CameraTrack, limbs: Sequence[CameraTrack], trunk_up_of: Callable[[float], FloatArray | None]
) -> float:
    """Return the roll (degrees) for which the limbs' cameras are most clearly below the reference camera.

    Down is the direction opposite to the up direction of the trunk.
    The roll is 0 if no other roll is clearly better.
    """
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
