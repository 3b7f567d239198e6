"""Angles of joints, contacts of the feet and clearance of the floor, as animators read them.

All values follow from joint centres, so they do not depend on the axes of a skeleton.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.skeleton import Motion, rest_pose

CONTACT_SPEED_M_S = 0.25
"""Speed (metres per second) of the ankle below which a low foot counts as standing. Derivation: the same
speed as that of merging's foot contacts."""

CONTACT_HEIGHT_M = 0.04
"""Clearance (metres) below which a slow foot counts as standing. Evidence: none; a toe passes the floor at
one or two centimetres in swing, but fast."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleCurve:
    """An angle over time.

    Attributes:
        name: Name of the angle, for example "left elbow".
        degrees: (T,) the angle.
        measured: (T,) True where cameras measured all joints that the angle depends on.
    """

    name: str
    degrees: FloatArray
    measured: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class FootCurve:
    """One foot over time.

    Attributes:
        name: Name of the foot, "left foot" or "right foot".
        clearance_m: (T,) height of the lowest point of the sole above the floor, metres.
        stands: (T,) True where the foot is low and slow.
        measured: (T,) True where cameras measured the foot.
    """

    name: str
    clearance_m: FloatArray
    stands: BoolArray
    measured: BoolArray


def angle_curves(motion: Motion) -> list[AngleCurve]:
    """Return the angles of elbows, shoulders, trunk and knees.

    Elbow and knee: 0 if the limb is straight. Trunk: between the line from chest to neck, which moves with
    the chest, and the vertical. Shoulder: between the upper arm and this line downwards. Angles whose joints
    are missing in the skeleton are left out.
    """
    at, seen = _places(motion), _masks(motion)
    out: list[AngleCurve] = []

    def add(name: str, roles: tuple[str, ...], first: FloatArray | None, second: FloatArray | None) -> None:
        if first is not None and second is not None:
            measured = np.logical_and.reduce([seen[role] for role in roles])
            out.append(AngleCurve(name=name, degrees=_between_deg(first, second), measured=measured))

    trunk = _way(at, "Spine1", "Neck")
    for side in ("Left", "Right"):
        upper, middle, end = (f"{side}{part}" for part in ("Arm", "ForeArm", "Hand"))
        add(f"{side.lower()} elbow", (upper, middle, end), _way(at, upper, middle), _way(at, middle, end))
    for side in ("Left", "Right"):
        upper, middle = f"{side}Arm", f"{side}ForeArm"
        down = None if trunk is None else -trunk
        add(f"{side.lower()} shoulder", (upper, middle, "Spine1"), _way(at, upper, middle), down)
    vertical = None if trunk is None else np.broadcast_to([0.0, 0.0, 1.0], trunk.shape)
    add("trunk lean", ("Spine1",), trunk, vertical)
    for side in ("Left", "Right"):
        upper, middle, end = (f"{side}{part}" for part in ("UpLeg", "Leg", "Foot"))
        add(f"{side.lower()} knee", (upper, middle, end), _way(at, upper, middle), _way(at, middle, end))
    return out


def foot_curves(motion: Motion) -> list[FootCurve]:
    """Return both feet over time. A foot without an ankle in the skeleton is left out."""
    skeleton = motion.skeleton
    poses, rest = motion.world_from_joint(), rest_pose(skeleton)[:, 2, 3]
    out = []
    for side in ("Left", "Right"):
        ankle, ball = (skeleton.index_of_role(f"{side}{part}") for part in ("Foot", "ToeBase"))
        if ankle is None:
            continue
        # At rest the soles are on the floor, so a joint's height above its height at rest is its clearance.
        heights = [poses[:, joint, 2, 3] - rest[joint] for joint in (ankle, ball) if joint is not None]
        tip = None if ball is None else skeleton.end_offsets_m[ball]
        if ball is not None and tip is not None and np.isfinite(tip).all():
            heights.append((poses[:, ball, :3, :3] @ tip + poses[:, ball, :3, 3])[:, 2])
        clearance = np.min(heights, axis=0)
        place = poses[:, ankle, :3, 3]
        speed = np.linalg.norm(np.gradient(place, axis=0), axis=1) * motion.fps if len(place) > 1 else 0.0
        out.append(
            FootCurve(
                name=f"{side.lower()} foot",
                clearance_m=clearance,
                stands=np.asarray((clearance < CONTACT_HEIGHT_M) & (speed < CONTACT_SPEED_M_S)),
                measured=motion.observed[:, ankle],
            )
        )
    return out


def _places(motion: Motion) -> dict[str, FloatArray]:
    """Return the centre (T,3) of each joint with a role, in the world."""
    centres = motion.world_from_joint()[..., :3, 3]
    return {role: centres[:, joint] for joint, role in enumerate(motion.skeleton.roles) if role}


def _masks(motion: Motion) -> dict[str, BoolArray]:
    """Return for each joint with a role the ticks (T,) at which cameras measured it."""
    return {role: motion.observed[:, joint] for joint, role in enumerate(motion.skeleton.roles) if role}


def _way(at: dict[str, FloatArray], first: str, last: str) -> FloatArray | None:
    """Return the vector (T,3) from a joint to another; None if one is missing."""
    return at[last] - at[first] if first in at and last in at else None


def _between_deg(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angle (T,) between vectors (T,3), degrees."""
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.asarray(np.degrees(np.arctan2(sine, np.einsum("ij,ij->i", first, second))))
