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
    explained in ``gt/README.txt``. Mounts and proportions differ from those that the camera names and the
    stature suggest; only ``gt/`` and ``skeleton.bvh`` hold the true ones. The same options give the same
    files.

    Args:
        options: The options of the capture.
        out_dir: A folder that does not exist or is empty. It is written completely or not at all.
        context: Threads, progress, cancellation.
        overwrite: Replace an earlier synthetic capture there.

    Raises:
        JobError: The folder is not empty, or the BVH file cannot be used.
        StoreError: The disk refuses a file.
        Cancelled: The work was cancelled.
    """
    from bodycap_batch.synthetic.making import write_synthetic_capture

    write_synthetic_capture(options, out_dir, context, overwrite=overwrite)
