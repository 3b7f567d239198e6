"""Adapt a motion to animation software: frame rate, joint names, spine joints, T-pose and root."""

from __future__ import annotations

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout.joint_names import rename_joints, rename_roles
from bodycap_batch.export.layout.resampling import resample, smooth
from bodycap_batch.export.layout.root_motion import apply_root_mode, floor_root_name, prepend_tpose
from bodycap_batch.model.skeleton import Motion

__all__ = ["added_root", "apply_layout"]


def added_root(motion: Motion, options: ExportOptions) -> str | None:
    """Return the name of the root on the floor that `apply_layout` adds to a motion; None if it adds none."""
    names = "hik" if any(motion.skeleton.bvh_channels) and options.target is None else options.names
    return floor_root_name(names, options.root)


def apply_layout(motion: Motion, options: ExportOptions) -> Motion:
    """Return the motion with the layout of the files for animation (BVH, GLB, FBX, USD).

    New joint names and additional spine joints do not move the existing joints in the world. A user's
    own skeleton gets no spine joints, and keeps its joint names unless the files are made for a program; the
    root on the floor is added for ``root: ground`` or if the names require it.

    Args:
        motion: The solved motion in the world.
        options: The export options of the job.
    """
    if options.smoothing_hz is not None:
        motion = smooth(motion, options.smoothing_hz)
    if options.fps is not None:
        motion = resample(motion, options.fps)
    is_user_skeleton = any(motion.skeleton.bvh_channels)
    if not is_user_skeleton:
        motion = rename_joints(motion, options.names)
    elif options.target is not None:
        motion = rename_roles(motion, options.names)
    if options.tpose:
        motion = prepend_tpose(motion)
    return apply_root_mode(motion, options.root, added_root(motion, options), tpose=options.tpose)
