"""How a motion is laid out for animation: rate, names and spine count, T-pose, root."""

from __future__ import annotations

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout.joint_names import rename_joints
from bodycap_batch.export.layout.resampling import resample, smooth
from bodycap_batch.export.layout.root_motion import apply_root_mode, floor_root_name, prepend_tpose
from bodycap_batch.model.skeleton import Motion

__all__ = ["apply_layout"]


def apply_layout(motion: Motion, options: ExportOptions) -> Motion:
    """The motion as the files for animation hold it (BVH, GLB, FBX, USD).

    Names and spine count leave the joints where they are; a user's own skeleton keeps both.

    Args:
        motion: The solved motion in the world.
        options: What the job asks for.
    """
    if options.smoothing_hz is not None:
        motion = smooth(motion, options.smoothing_hz)
    if options.fps is not None:
        motion = resample(motion, options.fps)
    own = any(motion.skeleton.bvh_channels)
    if not own:
        motion = rename_joints(motion, options.names)
    if options.tpose:
        motion = prepend_tpose(motion)
    return apply_root_mode(
        motion, options.root, floor_root_name("hik" if own else options.names, options.root)
    )
