"""Write one sentence per estimated quantity: how well the quantity is known, and advice for a better capture.

The sentences are part of the stored results. The report page splits each sentence at "; to reduce this, ".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodycap_batch.merging.body_calibration.calibrate_body import BodyCalibration
from bodycap_batch.merging.world.vertical import Vertical
from bodycap_batch.model.merge_report import MountSlipReport
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import split_side

_WELL_KNOWN_MOUNT_DEG = 5.0
"""Maximum sigma of a well-known mount's rotation, degrees per axis. Evidence: none.

The report gives advice for mounts with a larger sigma.
"""
_WELL_KNOWN_MOUNT_M = 0.02
"""Maximum sigma of a well-known mount's position, metres per axis. Evidence: none.

The report gives advice for mounts with a larger sigma.
"""
_WELL_KNOWN_SCALE = 0.02
"""Maximum relative sigma of a well-known metric scale. Evidence: none.

The report gives advice if the sigma of the scale is larger.
"""
_MOVEMENTS = {
    "Spine1": "walk straight ahead, turn round, and lift both arms to the side",
    "Spine": "walk straight ahead, turn round, then bend and twist the trunk",
    "Hips": "walk straight ahead, turn round, and lift each knee",
    "Neck": "nod and look over both shoulders",
    "Head": "nod and look over both shoulders",
    "Shoulder": "lift the shoulders, and move the {side} arm in circles",
    "Arm": "move the {side} arm in circles about the shoulder",
    "ForeArm": "bend the {side} elbow by 90°, then turn the {side} palm up and down",
    "Hand": "bend the {side} elbow by 90°, then bend and turn the {side} wrist",
    "UpLeg": "lift the {side} knee and move the knee in circles",
    "Leg": "bend the {side} knee by 90°",
    "Foot": "lift the {side} foot and move the foot in circles",
    "ToeBase": "lift the heel of the {side} foot while the toes stay on the floor",
}


def describe_swapped_sides(swapped: Mapping[str, float], *, all_limbs: bool) -> str:
    """Describe cameras on the wrong side of the body, and the likely reasons.

    Args:
        swapped: By camera, fraction of its frames on the wrong side of the body.
        all_limbs: True if no other camera is on a limb. The trunk's camera can then be the reason.

    Returns:
        A sentence for the report.
    """
    backward = ", or the camera on the trunk looks backward and its mount is not torso_back"
    return (
        f"{' and '.join(sorted(swapped))} stay on the wrong side of the body: left and right are exchanged "
        f"in the names of the cameras{backward if all_limbs else ''}"
    )


def describe_inverted_cameras(rolls_deg: Mapping[str, float], cameras: int) -> str:
    """Describe cameras that are mounted upside down.

    Args:
        rolls_deg: By camera, the roll of the solved mount relative to the usual mount, degrees.
        cameras: Number of all cameras of the body.

    Returns:
        A sentence for the report, with the measured rolls.
    """
    names = sorted(rolls_deg)
    measured = ", ".join(f"{abs(rolls_deg[name]):.0f}°" for name in names)
    every = " (all cameras)" if len(names) == cameras > 1 else ""
    return (
        f"these cameras seem to be mounted upside down: {' and '.join(names)}{every}; from the motion and "
        f"from the position of the limbs, the roll from the usual mount is {measured}; the body is solved "
        "with this roll, so if they are mounted upright, give their mounts (joint_from_cam)"
    )


def describe_slips(slips: Mapping[str, MountSlipReport]) -> str:
    """Describe mounts that slipped.

    Args:
        slips: By camera, the slip of its mount.

    Returns:
        A sentence for the report.
    """
    parts = [
        f"the mount of {name} slipped {slip.at_s:.1f} s after the start of the motion: the camera turned by "
        f"{slip.turned_deg:.0f}° and moved by {100.0 * slip.moved_m:.1f} cm"
        for name, slip in sorted(slips.items())
    ]
    return f"{'; '.join(parts)}; from then on, the body is solved with the new place of the camera"


def describe_unknown_way_up(camera: str) -> str:
    """Describe that no measurement shows which way up the reference camera is mounted.

    Args:
        camera: Name of the reference camera.

    Returns:
        A part of a sentence for the report.
    """
    return (
        f"; {camera} is assumed to be mounted upright: no cameras on both arms or both legs hang below it, "
        "so a mount that is upside down, and a body that is then upside down, cannot be noticed"
    )


def describe_mount(mount: Mount, *, t_pose: bool) -> str:
    """Describe how well the pose of a camera on its bone is known.

    Args:
        mount: The solved mount with its sigmas.
        t_pose: True if the calibration used a T-pose.

    Returns:
        A sentence for the report. If the mount is not well known, the sentence contains advice.
    """
    degrees, metres = float(np.degrees(mount.sigma_rad)), mount.sigma_m
    text = (
        f"the uncertainty of {mount.camera}'s mount is {degrees:.1f}° and {100.0 * metres:.1f} cm (1 sigma)"
    )
    if degrees <= _WELL_KNOWN_MOUNT_DEG and metres <= _WELL_KNOWN_MOUNT_M:
        return text
    side, part = split_side(mount.role)
    movement = _MOVEMENTS[part].format(side=side.lower())
    stand = "" if t_pose else ", or stand in a T-pose for two seconds first"
    return f"{text}; to reduce this, {movement}{stand}"


def describe_hinge(role: str, off_m: float) -> str:
    """Describe a hinge that the motion violates.

    Args:
        role: Anatomical name of the bone below the hinge.
        off_m: Sigma of the distance between the bone's far end and the plane of the hinge, metres.

    Returns:
        A sentence for the report, with advice.
    """
    side, part = split_side(role)
    hinge = "elbow" if part == "ForeArm" else "knee"
    joint = f"{side.lower()} {hinge}"
    return (
        f"the {joint} moves {100.0 * off_m:.1f} cm (1 sigma) out of its bending plane, which a real "
        f"{hinge} cannot do; to reduce this, strap the cameras above and below the {joint} so "
        "that no camera slides, and check the cameras' clocks (offset_s) and the direction of the "
        f"{joint}'s axis in the skeleton"
    )


def describe_scale(calibration: BodyCalibration) -> str:
    """Describe how well the metric scale is known.

    Args:
        calibration: The calibration of the body, with the scale.

    Returns:
        A sentence for the report. If the scale is not well known, the sentence contains advice.
    """
    scale = calibration.scale
    text = f"the uncertainty of the metric scale is {100.0 * scale.sigma_log:.1f} % (1 sigma)"
    used = {source.name for source in scale.sources if source.used}
    if scale.sigma_log <= _WELL_KNOWN_SCALE or used & {"known distance", "marker board"}:
        return text
    ways = ["give a known distance (merge.known_distance) or a board in the room (merge.marker_board)"]
    if len({mount.role for mount in calibration.mounts}) == 1:
        return (
            f"{text}, because all cameras are on one bone and only their distances determine the scale; to "
            "reduce this, wear a camera on another bone as well (a hand, an upper arm or the head), or "
            f"{ways[0]}"
        )
    if "mean stature" in used:
        ways.insert(0, "give the subject's height (height_m)")
    if calibration.t_pose_ns is None:
        ways.append("stand in a T-pose for two seconds first")
    return f"{text}; to reduce this, {' or '.join(ways)}"


def describe_vertical(vertical: Vertical, way_up: str = "") -> str:
    """Describe how well the vertical is known.

    Args:
        vertical: The estimated vertical.
        way_up: Text from `describe_unknown_way_up`; empty if it is known which way up the reference camera is
            mounted.

    Returns:
        A sentence for the report. If the vertical is not well known, the sentence contains advice.
    """
    text = (
        f"the uncertainty of the vertical, estimated from the {vertical.source}, is "
        f"{vertical.sigma_deg:.1f}° (1 sigma){way_up}"
    )
    if vertical.rests_on_lean_only():
        text = (
            f"{text}; the true error may be larger, because only the posture shows the vertical, and a "
            "constant lean of the trunk cannot be seen in the posture"
        )
    elif not vertical.is_determined():
        text = (
            f"{text}; the true error may be larger, because another, clearly different direction explains "
            "the observations nearly as well"
        )
    elif vertical.source != "body":
        return text
    return (
        f"{text}; to reduce this, walk a few steps upright, film the floor and two walls, or lay a marker "
        "board on the floor (merge.marker_board.placed)"
    )
