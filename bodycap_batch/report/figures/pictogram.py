"""Draw the person as a pictogram: which bones were measured, partly measured, filled or neither."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.bone_axes import bone_ends_m, has_floor_root
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.measured_parts import PartState, overall_state
from bodycap_batch.model.skeleton import Motion, rest_pose
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.figures.svg import element, svg_image

_WIDTH, _HEIGHT, _MARGIN = 168.0, 250.0, 16.0
"""Size of the drawing and its margin, SVG units."""
_CLASSES = {
    PartState.MEASURED: "measured",
    PartState.PARTLY: "partly",
    PartState.FILLED: "filled",
    PartState.UNMEASURED: "unknown",
}
"""Class of a bone in the style sheet, by its state."""
_THICKNESS = {
    "Hand": 9.0,
    "Foot": 10.0,
    "ToeBase": 8.0,
    "Neck": 11.0,
    "Shoulder": 11.0,
    "Hips": 24.0,
    "Spine": 24.0,
    "Spine1": 26.0,
}
"""Thickness of some bones, SVG units. It is a matter of taste."""
_THICK = 14.0
"""Thickness of all other bones, SVG units."""
_ARM = ("Arm", "ForeArm", "Hand")
_MIN_BONE_STATURE = 0.03
"""Shortest bone that is drawn, as a share of the drawn height. Evidence: none."""


def draw_pictogram(motion: Motion, filled: BoolArray) -> str:
    """Draw the skeleton at rest, seen from the front, with lowered arms.

    Args:
        motion: The motion.
        filled: (J,) True for joints that were filled with a plausible motion.

    Returns:
        The drawing as SVG.
    """
    skeleton = motion.skeleton
    at, ends = rest_pose(skeleton)[:, :3, 3], bone_ends_m(skeleton)
    share = motion.observed.mean(axis=0).tolist()
    flat_at, flat_ends = _lowered(skeleton.roles, at, ends)
    low, high = float(min(at[:, 2].min(), ends[:, 2].min())), float(max(at[:, 2].max(), ends[:, 2].max()))
    scale = (_HEIGHT - 2 * _MARGIN) / max(high - low, 1e-6)

    def on_page(point: FloatArray) -> tuple[float, float]:
        # Seen from the front, the left side of the body is on the right.
        return _WIDTH / 2 + scale * float(point[0]), _HEIGHT - _MARGIN - scale * (float(point[2]) - low)

    parts: list[str] = []
    for joint, role in enumerate(skeleton.roles):
        if (joint == 0 and has_floor_root(skeleton)) or not role:
            continue
        (x1, y1), (x2, y2) = on_page(flat_at[joint]), on_page(flat_ends[joint])
        kind = _CLASSES[overall_state(share[joint], share[joint], is_filled=bool(filled[joint]))]
        if role == "Head":
            centre = {"cx": (x1 + x2) / 2, "cy": (y1 + y2) / 2}
            parts.append(element("ellipse", class_=kind, **centre, rx=11.0, ry=abs(y2 - y1) / 2 + 4))
        elif np.hypot(x2 - x1, y2 - y1) > _MIN_BONE_STATURE * scale:
            thick = _THICKNESS.get(split_side(role)[1], _THICK)
            parts.append(element("line", class_=kind, x1=x1, y1=y1, x2=x2, y2=y2, stroke_width=thick))
    return svg_image(
        _WIDTH, _HEIGHT, "".join(parts), "The body from the front, by what was measured", class_="pictogram"
    )


def _lowered(roles: tuple[str, ...], at: FloatArray, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return starts and ends of the bones with each arm turned about its shoulder towards the hips."""
    at, ends = at.copy(), ends.copy()
    for side, angle_deg in (("Left", -68.0), ("Right", -112.0)):
        arm = [
            joint for joint, role in enumerate(roles) if split_side(role) in {(side, part) for part in _ARM}
        ]
        if not arm:
            continue
        pivot = at[arm[0]].copy()
        way = ends[arm[-1]] - pivot
        turn_rad = np.radians(angle_deg) - np.arctan2(way[2], way[0])
        rotation = so3_exp([0.0, -turn_rad, 0.0])
        for array in (at, ends):
            array[arm] = (array[arm] - pivot) @ rotation.T + pivot
    return at, ends
