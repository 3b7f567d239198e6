"""Bones projected into a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import transform_points
from bodycap_batch.overlay.body import Bones
from bodycap_batch.overlay.field import field_limit_rad, in_field

_SAMPLES = 25
_NEAR_M = 0.03
"""Nearer than this a bone is inside the camera's own housing."""
_FAR_OUT = 2.0
"""Parts further than so many pictures beside the picture are left out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneLine:
    """A visible stretch of one bone.

    Attributes:
        bone: Index into the body's bones.
        px: (S,2) line through these pixels at the lens's size, COLMAP origin.
        depth_m: (S,) along the optical axis.
        observed: True where cameras measured the joint that turns the bone.
    """

    bone: int
    px: FloatArray
    depth_m: FloatArray
    observed: bool


def bone_lines(lens: Camera, cam_from_world: FloatArray, bones: Bones) -> list[BoneLine]:
    """Project bones, cut off behind the camera, outside the lens's field and far beside the picture.

    Args:
        lens: Intrinsics; distortion bends the lines.
        cam_from_world: (4,4) the frame's pose.
        bones: The body at the frame's time.

    Returns:
        Lines that touch the picture, the farthest first.
    """
    share = np.linspace(0.0, 1.0, _SAMPLES)[None, :, None]
    near_end, far_end = bones.ends_in_world[:, None, 0], bones.ends_in_world[:, None, 1]
    x_in_cam = transform_points(cam_from_world, (1.0 - share) * near_end + share * far_end)
    flat = x_in_cam.reshape(-1, 3)
    visible = in_field(flat, field_limit_rad(lens), _NEAR_M) > 0.0
    px = np.full((len(flat), 2), np.nan)
    px[visible] = lens.project(flat[visible])
    size = np.array([lens.width_px, lens.height_px])
    outside = np.maximum(-px, px - size) / size
    visible &= np.nan_to_num(outside, nan=np.inf).max(axis=1) < _FAR_OUT
    touching = np.nan_to_num(outside, nan=np.inf).max(axis=1) < 0.0
    out: list[BoneLine] = []
    for bone, start, stop in _runs(visible.reshape(len(bones.observed), -1)):
        part = slice(bone * _SAMPLES + start, bone * _SAMPLES + stop)
        if touching[part].any():
            line = BoneLine(
                bone=bone, px=px[part], depth_m=flat[part, 2], observed=bool(bones.observed[bone])
            )
            out.append(line)
    return sorted(out, key=lambda line: -float(line.depth_m.mean()))


def _runs(visible: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[tuple[int, int, int]]:
    """Row, first and one past the last column of every stretch of two or more."""
    padded = np.pad(visible, ((0, 0), (1, 1)))
    change = np.diff(padded.astype(np.int8), axis=1)
    rows, starts = np.nonzero(change == 1)
    _, stops = np.nonzero(change == -1)
    return [
        (int(row), int(start), int(stop))
        for row, start, stop in zip(rows, starts, stops, strict=True)
        if stop - start > 1
    ]
