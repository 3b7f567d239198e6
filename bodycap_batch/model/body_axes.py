"""Up, left and forward of a body from the centres of its own joints, and how near a pose is to a T-pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.skeleton import SkeletonModel

SIDES = {"Left": 1.0, "Right": -1.0}
"""Sign of the left direction of each side."""

_PAIRS = ("UpLeg", "Arm", "Shoulder", "Leg", "ForeArm", "Hand")
"""Parts on both sides of the body whose connecting line is the left direction, the best pair first. The hips
are the widest part of the body that no posture deforms."""

_MIN_WIDTH_RATIO = 0.02
"""Minimum distance of the joints of a pair, as a part of the largest distance of a joint from the hips.
Derivation: far above rounding errors and far below the width of shoulders or hips."""

_MIN_COSINE = 0.5
"""Minimum cosine between the directions of trunk and legs, and between a leg and their mean. Derivation:
people stand with less than 60°; bones along one axis have 180° or no width."""

_MAX_COSINE = 0.7
"""Maximum cosine between the left direction and the direction up, between an arm and the other side, and
between an arm and the direction up. Derivation: half of a right angle."""

_SNAP_DEG = {"legs": 8.0, "trunk": 15.0}
"""Maximum angle (degrees) between the direction up of a body and an axis of the file that is then taken as
the vertical. Evidence: none; trunks lean from hips to head, and ankles are some centimetres behind the
hips."""

_MIN_TURN_DEG = 0.05
"""Maximum rotation (degrees) that is treated as none. Derivation: rounded offsets of 10 cm with four decimals
in the file give less."""

_MAX_A_POSE_DEG = 60.0
"""Maximum angle (degrees) of the arms to the sides in an A-pose. Derivation: 45° are usual."""

_A_POSE_WEIGHT = 0.5
"""Weight of the angle of the arms to the sides up to `_MAX_A_POSE_DEG`. Derivation: a T-pose is then nearer
than an A-pose, and an A-pose of 45° is within `_MAX_T_POSE_DEG` of a rig."""


@dataclass(frozen=True, slots=True)
class BodyAxes:
    """The axes of a body in T poses.

    Attributes:
        left: (T,3) unit vectors to the left.
        up: (T,3) unit vectors up.
        from_legs: True if the legs say where up is; else the trunk.
        is_body: (T,) False for poses that no body has, for example if all bones lie along one axis.
    """

    left: FloatArray
    up: FloatArray
    from_legs: bool
    is_body: BoolArray


def body_axes(skeleton: SkeletonModel, at: FloatArray) -> BodyAxes | None:
    """Return the axes of a body from its joint centres (T,J,3); None if it has no pair or no direction up."""
    place = {role: at[:, joint] for joint, role in enumerate(skeleton.roles) if role}
    start = place.get("Hips", at[:, 0])
    top = next((place[role] for role in ("Head", "Neck", "Spine1") if role in place), None)
    trunk = None if top is None else _unit(top - start)
    ends = {side: next((e for e in ("Foot", "Leg") if side + e in place), None) for side in SIDES}
    legs = [
        _unit(place[f"{side}UpLeg"] - place[f"{side}{end}"])
        for side, end in ends.items()
        if end is not None and f"{side}UpLeg" in place
    ]
    has_legs = len(legs) == len(SIDES)  # the mean of two legs is vertical, even if they are spread
    up = _unit(np.sum(legs, axis=0)) if has_legs else trunk
    if up is None or not any({f"Left{part}", f"Right{part}"} <= place.keys() for part in _PAIRS):
        return None
    size = np.max([np.linalg.norm(each - start, axis=1) for each in place.values()], axis=0)
    left = np.zeros_like(up)
    for part in _PAIRS:
        if {f"Left{part}", f"Right{part}"} <= place.keys():
            across = place[f"Left{part}"] - place[f"Right{part}"]
            is_new = ~left.any(axis=1) & (np.linalg.norm(across, axis=1) > _MIN_WIDTH_RATIO * size)
            left[is_new] = _unit(across[is_new])
    is_body = left.any(axis=1) & (np.abs(_dot(left, up)) < _MAX_COSINE)
    for each in [*legs, *([] if trunk is None else [trunk])]:
        is_body &= _dot(each, up) > _MIN_COSINE
    for side, sign in SIDES.items():
        if {f"{side}Arm", f"{side}ForeArm"} <= place.keys():
            arm = _unit(place[f"{side}ForeArm"] - place[f"{side}Arm"])
            is_body &= (sign * _dot(arm, left) > -_MAX_COSINE) & (_dot(arm, up) < _MAX_COSINE)
    return BodyAxes(left, up, has_legs, np.asarray(is_body))


def upright_rotation(axes: BodyAxes) -> FloatArray:
    """Return the rotation (3,3) that turns the first pose upright, so that it faces −Y.

    If an axis of the file is near the direction up of the body, it is the vertical: programs give bodies
    along an axis, while legs and trunks lean.
    """
    left, up = axes.left[0], axes.up[0]
    nearest = np.eye(3)[np.argmax(np.abs(up))] * np.sign(up[np.argmax(np.abs(up))])
    limit = np.radians(_SNAP_DEG["legs" if axes.from_legs else "trunk"])
    if up @ nearest > np.cos(limit):
        up = nearest
    left = _unit(left - (left @ up) * up)
    turn = np.stack([left, np.cross(up, left), up])
    if np.trace(turn) > 1.0 + 2.0 * np.cos(np.radians(_MIN_TURN_DEG)):
        return np.eye(3)
    return np.asarray(turn)


def t_pose_deviation_deg(skeleton: SkeletonModel, at: FloatArray) -> FloatArray:
    """Return how far each pose (T,J,3) is from a T-pose, degrees; infinity for a pose that no body has.

    It is the largest angle of trunk, legs and arms to their directions in a T-pose. The angle of arms that
    are lowered at the sides (an A-pose) counts half.
    """
    axes = body_axes(skeleton, at)
    if axes is None:
        return np.full(len(at), np.inf)
    forward, worst = np.cross(axes.left, axes.up), np.zeros(len(at))
    place = {role: at[:, joint] for joint, role in enumerate(skeleton.roles) if role}
    for side, sign in SIDES.items():
        for upper, lower in (("UpLeg", "Leg"), ("Leg", "Foot")):
            if {side + upper, side + lower} <= place.keys():
                worst = np.maximum(worst, _angle_deg(place[side + upper] - place[side + lower], axes.up))
        chain = [place.get(side + part) for part in ("Arm", "ForeArm", "Hand")]
        if chain[0] is None or chain[1] is None or chain[2] is None:
            return np.full(len(at), np.inf)
        arm, forearm = chain[1] - chain[0], chain[2] - chain[1]
        aside = _angle_deg(arm, sign * axes.left)
        off_plane = np.abs(90.0 - _angle_deg(arm, forward))
        hanging = np.where(aside <= _MAX_A_POSE_DEG, _A_POSE_WEIGHT * aside, aside)
        worst = np.max([worst, hanging, off_plane, _angle_deg(arm, forearm)], axis=0)
    return np.where(axes.is_body, worst, np.inf)


def toes_point_back(skeleton: SkeletonModel, at: FloatArray) -> bool:
    """Return True if the toes of a pose (J,3) that stands upright and faces −Y point back."""
    feet = [[skeleton.index_of_role(side + part) for part in ("Foot", "ToeBase")] for side in SIDES]
    steps = [at[toe] - at[foot] for foot, toe in feet if foot is not None and toe is not None]
    return bool(steps) and float(np.mean(steps, axis=0)[1]) > 0.5 * float(
        np.linalg.norm(np.mean(steps, axis=0))
    )


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray((first * second).sum(axis=-1))


def _unit(vectors: FloatArray) -> FloatArray:
    """Return vectors (...,3) of length 1; zero vectors stay zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def _angle_deg(first: FloatArray, second: FloatArray) -> FloatArray:
    cosine = _dot(_unit(first), _unit(second))
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
