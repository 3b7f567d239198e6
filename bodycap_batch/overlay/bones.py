"""Describe a moving skeleton by straight bones at any time, and project them into an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import transform_points
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.skeleton_presets import split_side
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
class Bones:
    """The positions of all bones at one time, ready to be projected or drawn.

    Attributes:
        ends_in_world: (B,2,3) near and far end of each bone in the world, metres.
        observed: (B,) True if cameras measured the joint that rotates the bone.
    """

    ends_in_world: FloatArray
    observed: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class BoneMotion:
    """The bones of a motion at each tick (time step), for overlays and the preview.

    Attributes:
        joints: (B,) index of the joint that rotates each bone.
        sides: (B,) side of each bone: "Left", "Right" or "".
        times_ns: (T,) common time of each tick, nanoseconds.
        ends_in_world: (T,B,2,3) near and far end of each bone in the world, metres.
        observed: (T,B) True if cameras measured the joint that rotates the bone.
    """

    joints: IntArray
    sides: tuple[str, ...]
    times_ns: IntArray
    ends_in_world: FloatArray
    observed: BoolArray

    def __post_init__(self) -> None:
        bones, ticks = len(self.sides), len(self.times_ns)
        set_array(self, "joints", (bones,), np.int64)
        set_array(self, "times_ns", (ticks,), np.int64)
        set_array(self, "ends_in_world", (ticks, bones, 2, 3))
        set_array(self, "observed", (ticks, bones), np.bool_)

    def bones_at(self, common_ns: int) -> Bones | None:
        """Return the bones at a common time, or None if this time is outside the motion.

        The ends of a bone are interpolated between two ticks. A bone is observed only if it is observed at
        both ticks.
        """
        ticks = len(self.times_ns)
        if not ticks or not self.times_ns[0] <= common_ns <= self.times_ns[-1]:
            return None
        after = min(int(np.searchsorted(self.times_ns, common_ns)), ticks - 1)
        before = max(after - 1, 0)
        interval_ns = int(self.times_ns[after] - self.times_ns[before])
        alpha = (common_ns - int(self.times_ns[before])) / interval_ns if interval_ns else 1.0
        ends = (1.0 - alpha) * self.ends_in_world[before] + alpha * self.ends_in_world[after]
        return Bones(ends_in_world=ends, observed=self.observed[before] & self.observed[after])


def bones_from_motion(motion: Motion, shown: BoolArray | None = None) -> BoneMotion:
    """Return the bones of a motion.

    Each joint has one bone to each of its children. A joint with an end point also has a bone to this point.

    Args:
        motion: The motion.
        shown: (J,) joints between which bones are returned; None for all joints.
    """
    skeleton = motion.skeleton
    shown = np.ones(len(skeleton.joints), dtype=bool) if shown is None else shown
    world_from_joint = motion.world_from_joint()
    centres = world_from_joint[..., :3, 3]
    parents = skeleton.parents
    children = np.flatnonzero(skeleton.offsets_m.any(axis=1) & (parents >= 0) & shown & shown[parents])
    tipped = np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1) & shown)
    tips = world_from_joint[:, tipped, :3, :3] @ skeleton.end_offsets_m[tipped][..., None]
    starts = np.concatenate([parents[children], tipped])
    far_ends = np.concatenate([centres[:, children], tips[..., 0] + centres[:, tipped]], axis=1)
    return BoneMotion(
        joints=starts,
        sides=tuple(
            split_side(skeleton.roles[joint] or skeleton.joints[joint])[0] for joint in (*children, *tipped)
        ),
        times_ns=motion.times_ns(),
        ends_in_world=np.stack([centres[:, starts], far_ends], axis=2),
        observed=motion.observed[:, starts],
    )


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
