"""How a motion is laid out for animation: rate, names and spine count, T-pose, root."""

from __future__ import annotations

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout.names import rename
from bodycap_batch.export.layout.rates import resample, smooth
from bodycap_batch.export.layout.roots import floor_name, place_root, with_tpose
from bodycap_batch.model.skeleton import Motion

__all__ = ["lay_out"]


def lay_out(motion: Motion, options: ExportOptions) -> Motion:
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
        motion = rename(motion, options.names)
    if options.tpose:
        motion = with_tpose(motion)
    return place_root(motion, options.root, floor_name("hik" if own else options.names, options.root))
