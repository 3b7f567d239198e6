"""The projection of bones into an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import transform_points
from bodycap_batch.overlay.bone_motion import Bones
from bodycap_batch.overlay.lens_field import field_margin, max_field_angle_rad

_SAMPLES = 25
"""Points on each bone; lens distortion bends the line through them. Evidence: none."""
_MIN_DEPTH_M = 0.03
"""Metres. A nearer part of a bone is inside the camera's own housing."""
_MAX_OUTSIDE = 2.0
"""Image widths or heights outside the image beyond which a part of a bone is omitted. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneLine:
    """A visible part of one bone.

    Attributes:
        bone: Index of the bone in `Bones`.
        px: (S,2) pixels of the line's points at the lens's image size, COLMAP origin.
        depth_m: (S,) depth along the optical axis.
        observed: True if cameras measured the joint that turns the bone.
    """

    bone: int
    px: FloatArray
    depth_m: FloatArray
    observed: bool


def project_bones(lens: Camera, cam_from_world: FloatArray, bones: Bones) -> list[BoneLine]:
    """Project bones into an image.

    Parts behind the camera, outside the lens's field of view or far outside the image are omitted.

    Args:
        lens: Intrinsics; distortion bends the lines.
        cam_from_world: (4,4) the frame's pose.
        bones: The bones at the frame's time.

    Returns:
        Lines with at least one point in the image, the farthest first.
    """
    share = np.linspace(0.0, 1.0, _SAMPLES)[None, :, None]
    near_end, far_end = bones.ends_in_world[:, None, 0], bones.ends_in_world[:, None, 1]
    x_in_cam = transform_points(cam_from_world, (1.0 - share) * near_end + share * far_end)
    samples = x_in_cam.reshape(-1, 3)
    visible = field_margin(samples, max_field_angle_rad(lens), _MIN_DEPTH_M) > 0.0
    px = np.full((len(samples), 2), np.nan)
    px[visible] = lens.project(samples[visible])
    size = np.array([lens.width_px, lens.height_px])
    outside = np.nan_to_num(np.maximum(-px, px - size) / size, nan=np.inf).max(axis=1)
    visible &= outside < _MAX_OUTSIDE
    in_image = outside < 0.0
    lines: list[BoneLine] = []
    for bone, bone_visible in enumerate(visible.reshape(len(bones.observed), -1)):
        for start, stop in runs(bone_visible):
            part = slice(bone * _SAMPLES + start, bone * _SAMPLES + stop)
            if stop - start > 1 and in_image[part].any():
                lines.append(
                    BoneLine(
                        bone=bone, px=px[part], depth_m=samples[part, 2], observed=bool(bones.observed[bone])
                    )
                )
    return sorted(lines, key=lambda line: -float(line.depth_m.mean()))
