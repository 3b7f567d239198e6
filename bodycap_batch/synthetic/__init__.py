"""Synthetic captures of a person with body cameras in a textured room: videos with exact ground truth."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.synthetic.options import SynthOptions

__all__ = ["SynthOptions", "synthesise"]


def synthesise(options: SynthOptions, out_dir: Path, context: StageContext) -> None:
    """Write a synthetic capture.

    The folder holds ``<camera>.mp4`` (or ``poses/<camera>.tum``), ``calib.json``, ``skeleton.bvh`` with the
    true proportions, and the ground truth in ``gt/``: ``<camera>.tum``, ``joints.npz``, ``motion.bvh`` and
    ``mounts.json``, with free clocks or sound also ``clocks.json``, and with the walk ``gait`` also
    ``contacts.json``. The file ``gt/README.txt`` explains
    the ground truth. The true mounts differ from the nominal mounts of the camera names. The true
    proportions differ from the nominal proportions of a person of this stature. Only ``gt/`` and
    ``skeleton.bvh`` hold the true values. Equal options give equal files.

    Args:
        options: The options of the capture.
        out_dir: Path of the folder to write. It must not exist, or must be empty. The folder is written
            completely or not at all.
        context: Number of threads, progress reports and cancellation.

    Raises:
        JobError: The folder exists and is not empty, or the BVH file cannot be used.
        StoreError: A file cannot be written to the disk.
        Cancelled: The work was cancelled.
    """
    from bodycap_batch.synthetic.making import write_synthetic_capture

    write_synthetic_capture(options, out_dir, context)
