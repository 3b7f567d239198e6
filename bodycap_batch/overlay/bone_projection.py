"""Project bones into an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import transform_points
from bodycap_batch.overlay.bone_motion import Bones
from bodycap_batch.overlay.lens_field import field_margin, max_field_angle_rad

_SAMPLES = 25
"""Number of points on each bone. They are projected separately, because lens distortion bends the bone's
line. Evidence: none."""
_MIN_DEPTH_M = 0.03
"""Metres: minimum depth of a visible part of a bone. A nearer part is inside the camera's own housing."""
_MAX_OUTSIDE = 2.0
"""Maximum distance of a drawn bone from the image, in image widths or heights. Bone parts farther outside are
omitted. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneLine:
    """A visible part of one bone.

    Attributes:
        bone: Index of the bone in `Bones`.
        px: (S,2) pixels of the line's points at the image size of the lens, with COLMAP's origin.
        depth_m: (S,) depth of these points along the optical axis, metres.
        observed: True if cameras measured the joint that rotates the bone.
    """

    bone: int
    px: FloatArray
    depth_m: FloatArray
    observed: bool


def project_bones(lens: Camera, cam_from_world: FloatArray, bones: Bones) -> list[BoneLine]:
    """Project bones into an image.

    Three kinds of parts are omitted: parts behind the camera, parts outside the field of view of the lens,
    and parts far outside the image.

    Args:
        lens: Intrinsics of the camera. The lines are bent by the lens distortion.
        cam_from_world: (4,4) pose of the frame.
        bones: The bones at the time of the frame.

    Returns:
        Lines with at least one point in the image, the farthest line first.
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
