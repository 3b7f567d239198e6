"""Which way up a camera sits: four rolls about its axis, tried where the job states no orientation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
MIN_COST_DIFFERENCE = 8.0
"""Half the squared sigmas by which another roll has to explain a camera better: 4 sigma. Nobody's habits in
wearing cameras are known better than that the names' usual places are usual."""
_MIN_DOWN_COSINE, _MIN_COSINE_GAIN = 0.3, 0.4
"""Hands that hang lie 45° and more below a chest's camera (cosine 0.7); about a level axis they average 0."""
_LEGS = frozenset({"UpLeg", "Leg", "Foot", "ToeBase"})
_PARTS_BELOW = {
    "Hips": _LEGS,
    "Spine": _LEGS,
    "Spine1": _LEGS | {"ForeArm", "Hand"},
    "Neck": _LEGS | {"Arm", "ForeArm", "Hand"},
    "Head": _LEGS | {"Shoulder", "Arm", "ForeArm", "Hand"},
}
"""Parts whose cameras lie below the trunk's while elbows are bent, too: hands at work are above the belt, and
shoulders always above the chest's camera."""
_TICKS, _ITERATIONS = 30, 12
_ENOUGH_TOGETHER = 15


@dataclass(frozen=True, slots=True)
class RollSearch:
    """How well each roll of a camera explains its motion beside the trunk's.

    Attributes:
        camera: Camera name.
        costs: Half the sum of squares at each of `ROLLS_DEG`, against the usual way up.
        chosen_deg: The roll taken.
    """

    camera: str
    costs: tuple[float, ...]
    chosen_deg: float

    def runner_up(self) -> tuple[float, float]:
        """The best roll that was not taken, and how much more it costs (less than nothing where close)."""
        chosen = self.costs[ROLLS_DEG.index(self.chosen_deg)]
        rest = [(cost - chosen, roll) for roll, cost in zip(ROLLS_DEG, self.costs, strict=True)]
        cost, roll = min(pair for pair in rest if pair[1] != self.chosen_deg)
        return roll, cost


def with_roll(mount: Mount, degrees: float) -> Mount:
    """The mount with its camera turned about the optical axis."""
    turn = make_transform(so3_exp([0.0, 0.0, np.radians(degrees)]), np.zeros(3))
    return replace(mount, joint_from_cam=mount.joint_from_cam @ turn)


def search_rolls(
    inputs: MergeInputs,
    tracks: Sequence[CameraTrack],
    scale: float,
    known: tuple[FloatArray | None, tuple[int, int] | None],
    step: Callable[[], None],
) -> tuple[RollSearch, ...]:
    """Try each limb's camera beside the trunk's in all four rolls.

    Args:
        inputs: The body and its mounts' priors.
        tracks: Cleaned tracks, the trunk's first.
        scale: Metres per map unit, roughly.
        known: The vertical in the map, and from when to when a T-pose stands, where known.
        step: Called after each iteration; may raise to stop.
    """
    trunk = tracks[0]
    return tuple(
        _search_roll(inputs, (trunk, track), (scale, *known), step)
        for track in tracks[1:]
        if has_unknown_roll(inputs.mount_of(track.camera))
        and inputs.mount_of(track.camera).role != inputs.mount_of(trunk.camera).role
        and track.poses_at(trunk.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1].sum() >= _ENOUGH_TOGETHER
    )


def has_unknown_roll(mount: Mount) -> bool:
    """Whether a mount's orientation rests on its name alone: a job that states its sigma vouches for it."""
    return mount.by_name


def _search_roll(
    inputs: MergeInputs,
    pair: tuple[CameraTrack, CameraTrack],
    known: tuple[float, FloatArray | None, tuple[int, int] | None],
    step: Callable[[], None],
) -> RollSearch:
    scale, up, t_pose_ns = known
    roles = [inputs.mount_of(track.camera).role for track in pair]
    bones = kinematic_chain(inputs.skeleton, roles)
    index = {bone.role: position for position, bone in enumerate(bones)}
    own = [replace(track, bone=index[role]) for track, role in zip(pair, roles, strict=True)]
    samples = take_samples(own, scale, _TICKS, up, t_pose_ns)
    camera, costs = pair[1].camera, []
    for roll in ROLLS_DEG:
        priors = {track.camera: inputs.mount_of(track.camera) for track in pair}
        priors[camera] = with_roll(priors[camera], roll)
        calibration = CalibrationGraph(inputs.skeleton, bones, samples, priors, scale, step)
        costs.append(calibration.solve(scale, iterations=_ITERATIONS))
    off = np.array(costs) - costs[0]
    best = int(np.argmin(off))
    return RollSearch(
        camera, tuple(off.tolist()), ROLLS_DEG[best] if off[best] < -MIN_COST_DIFFERENCE else 0.0
    )


def _hanging_cameras(inputs: MergeInputs, tracks: Sequence[CameraTrack]) -> list[CameraTrack]:
    """The cameras that hang below the trunk's, the first: none where those of one side alone do.

    One hand alone lies beside the chest, which is no hanging.
    """
    below = _PARTS_BELOW.get(inputs.mount_of(tracks[0].camera).role, frozenset())
    sides = [split_side(inputs.mount_of(track.camera).role) for track in tracks]
    found = [(side, track) for (side, part), track in zip(sides, tracks, strict=True) if part in below]
    return [track for _, track in found] if {"Left", "Right"} <= {side for side, _ in found} else []


def mean_down_cosine(trunk: CameraTrack, limbs: Sequence[CameraTrack], up: FloatArray) -> float:
    """Mean cosine between down and the way from the trunk's camera to the limbs', else 0."""
    cosines = [np.zeros(0)]
    for track in limbs:
        poses, valid = track.poses_at(trunk.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)
        way = trunk.map_from_cam[valid, :3, 3] - poses[valid, :3, 3]
        cosines.append((way @ up) / np.maximum(np.linalg.norm(way, axis=1), 1e-12))
    together = np.concatenate(cosines)
    return float(together.mean()) if len(together) else 0.0


def reference_roll(
    inputs: MergeInputs,
    tracks: Sequence[CameraTrack],
    up_of: Callable[[float], FloatArray | None],
    own_up: Callable[[float], FloatArray | None] = lambda _: None,
) -> tuple[float, FloatArray | None]:
    """Roll (degrees) of the trunk's camera and the vertical: limbs hang below it more often than not.

    Args:
        inputs: The mounts' priors.
        tracks: Cleaned tracks, the trunk's first.
        up_of: Gives, for a roll, the vertical (3,) of the walk or the walls near that roll's own up, or None.
        own_up: Gives, for a roll, where the trunk itself points (3,), None where it tells nothing. It decides
            where nothing around does, and is no vertical then.
    """
    trunk, limbs, usual = tracks[0], _hanging_cameras(inputs, tracks), up_of(0.0)
    hang = 0.0 if usual is None else mean_down_cosine(trunk, limbs, usual)
    if not has_unknown_roll(inputs.mount_of(trunk.camera)) or not limbs or hang > _MIN_DOWN_COSINE:
        return 0.0, usual
    found = [
        (mean_down_cosine(trunk, limbs, up), roll, up)
        for roll in ROLLS_DEG[1:]
        if (up := up_of(roll)) is not None
    ]
    if usual is None and not found:
        return _roll_from_trunk(trunk, limbs, own_up), None
    best = max(found, key=lambda each: each[0], default=(0.0, 0.0, usual))
    return (best[1], best[2]) if best[0] > hang + _MIN_COSINE_GAIN else (0.0, usual)


def _roll_from_trunk(
    trunk: CameraTrack, limbs: Sequence[CameraTrack], own_up: Callable[[float], FloatArray | None]
) -> float:
    """The roll (degrees) at which limbs hang below the trunk as it points itself; 0 unless that is clear."""
    hang = {
        roll: mean_down_cosine(trunk, limbs, up) for roll in ROLLS_DEG if (up := own_up(roll)) is not None
    }
    if not hang:
        return 0.0
    best = max(hang, key=lambda roll: hang[roll])
    return best if hang[best] > max(_MIN_COSINE_GAIN, hang.get(0.0, 0.0) + _MIN_COSINE_GAIN) else 0.0
