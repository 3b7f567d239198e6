"""A sentence for every solved constant: how well it is known, and which movement would tell more."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodycap_batch.merging.body_calibration.calibrate_body import BodyCalibration
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_WELL_KNOWN_DEG = 5.0
_WELL_KNOWN_M = 0.02
_MOVEMENTS = {
    "Spine1": "walk straight ahead, turn round, and lift both arms to the side",
    "Spine": "walk straight ahead, turn round, and bend and twist the trunk",
    "Hips": "walk straight ahead, turn round, and lift each knee",
    "Neck": "nod and look over both shoulders",
    "Head": "nod and look over both shoulders",
    "Shoulder": "shrug, and circle the {side} arm",
    "Arm": "circle the {side} arm about the shoulder",
    "ForeArm": "swing the {side} elbow through 90°, then turn the {side} palm up and down",
    "Hand": "swing the {side} elbow through 90°, then bend and turn the {side} wrist",
    "UpLeg": "lift and circle the {side} knee",
    "Leg": "bend the {side} knee through 90°",
    "Foot": "lift the {side} foot and circle the ankle",
    "ToeBase": "roll over the toes of the {side} foot",
}


def describe_clock(camera: str, doubt: Mapping[str, float], offset_s: float) -> str:
    """What a doubted clock looks like, and the offset that would suit it."""
    way = "behind" if doubt["shift_s"] > 0.0 else "ahead"
    return (
        f"{camera} moves about the body as if its clock were {abs(doubt['shift_s']):.1f} s {way}; with "
        f"an offset_s of about {offset_s:.1f} its place would scatter {1.0 - doubt['scatter_left']:.0%} less"
    )


def describe_swapped_sides(exchanged: Mapping[str, float]) -> str:
    """What limbs on the wrong side of the body mean."""
    return (
        f"{' and '.join(sorted(exchanged))} stay on the other side of the body: left and right are "
        "exchanged in the cameras' names, or the trunk's camera looks back and its mount is not torso_back"
    )


def describe_mount(mount: Mount, *, t_pose: bool) -> str:
    """How well a camera's place on its bone is known.

    Args:
        mount: Solved, with its sigmas.
        t_pose: A T-pose was used.
    """
    degrees, metres = float(np.degrees(mount.sigma_rad)), mount.sigma_m
    text = f"{mount.camera}'s mount is known to {degrees:.1f}° and {100.0 * metres:.1f} cm (1 sigma)"
    if degrees <= _WELL_KNOWN_DEG and metres <= _WELL_KNOWN_M:
        return text
    side, part = split_side(mount.role)
    movement = _MOVEMENTS[part].format(side=side.lower())
    stand = "" if t_pose else ", or stand in a T-pose for two seconds first"
    return f"{text}; to know it better, {movement}{stand}"


def describe_hinge(role: str, off_m: float) -> str:
    """What it means that a hinged bone leaves its hinge.

    Args:
        role: Of the bone below the hinge.
        off_m: Sigma by which its far end does.
    """
    side, part = split_side(role)
    joint = f"{side.lower()} {'elbow' if part == 'ForeArm' else 'knee'}"
    return (
        f"the {joint} bends {100.0 * off_m:.1f} cm (1 sigma) out of its plane and is not held to it; "
        f"to know it better, strap the cameras above and below the {joint} so that none slides, and check "
        f"their clocks (offset_s) and which way its axis lies in the skeleton"
    )


def describe_scale(calibrated: BodyCalibration) -> str:
    """How well the metric scale is known."""
    text = f"the metric scale is known to {100.0 * calibrated.scale.sigma_log:.1f} % (1 sigma)"
    used = {source.name for source in calibrated.scale.sources if source.used}
    if calibrated.scale.sigma_log <= 0.02 or used & {"known distance", "marker board"}:
        return text
    ways = ["name a known distance (merge.known_distance) or a board in the room (merge.marker_board)"]
    if len({mount.role for mount in calibrated.mounts}) == 1:
        return (
            f"{text}: all cameras sit on one bone, so that only their distance on it tells; to know it "
            f"better, wear one on another bone as well (a hand, an upper arm or the head), or {ways[0]}"
        )
    if "mean stature" in used:
        ways.insert(0, "give the subject's height (height_m)")
    if calibrated.t_pose_ns is None:
        ways.append("stand in a T-pose for two seconds first")
    return f"{text}; to know it better, {' or '.join(ways)}"


def describe_vertical(calibrated: BodyCalibration) -> str:
    """How well the vertical is known."""
    up = calibrated.vertical
    text = f"up is known to {up.sigma_deg:.1f}° (1 sigma), from the {up.source}"
    if up.by_habit():
        text = (
            f"{text}, and not for certain: nothing else tells it, and a lean that lasts all the time "
            "does not show in it"
        )
    elif not up.determined():
        text = (
            f"{text}, and not for certain: another direction, at a right angle or so to it, explains the "
            f"leaning nearly as well"
        )
    elif up.source != "body":
        return text
    return (
        f"{text}; to know it better, walk a few steps upright, film the floor and two walls, or lay a "
        f"marker board on the floor (merge.marker_board.placed)"
    )
