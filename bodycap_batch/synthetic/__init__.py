"""A person with body cameras in a textured room: videos and their exact ground truth."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.synthetic.options import SynthOptions

__all__ = ["SynthOptions", "synthesise"]


def synthesise(
    options: SynthOptions, out_dir: Path, context: StageContext, *, overwrite: bool = False
) -> None:
    """Write a synthetic capture.

    The folder holds ``<camera>.mp4`` (or ``poses/<camera>.tum``), ``calib.json``, ``skeleton.bvh`` (the true
    proportions) and the truth in ``gt/``: ``<camera>.tum``, ``joints.npz``, ``motion.bvh``, ``mounts.json``,
    explained in ``gt/README.txt``. Mounts and proportions differ from what their names and the stature
    promise; nothing outside ``gt/`` and ``skeleton.bvh`` tells. Same options, same files.

    Args:
        options: What to make.
        out_dir: A folder that does not exist or is empty. It appears complete, or not at all.
        context: Threads, progress and cancelling.
        overwrite: Replace an earlier synthetic capture there.

    Raises:
        JobError: The folder is in use, or the BVH file cannot be.
        StoreError: The disk refuses.
        Cancelled: On request.
    """
    from bodycap_batch.synthetic.making import make

    make(options, out_dir, context, overwrite=overwrite)
