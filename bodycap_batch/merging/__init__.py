"""Stage 4, merging: fit a skeleton to the cameras' trajectories. The result is in the world: metres, z up.

Only this package imports gtsam.
"""

from __future__ import annotations

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.merge_data import MergeInputs, MergeResult

__all__ = ["merge_trajectories"]


def merge_trajectories(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """Estimate mounts, metric scale, world frame and the body's motion from the cameras' trajectories.

    Args:
        inputs: Trajectories in the gauges of their maps, clocks, skeleton and mount priors.
        options: Options of the stage, among them the number of ticks per second.
        context: Receives the progress, and reports whether the stage should stop. The stage uses it after
            each iteration of the optimiser.

    Returns:
        The motion of the body, the mounts, the trajectories in the world, and the report.

    Raises:
        EstimationError: Too few frames were localised, or no source determines the scale.
        JobError: The job names a camera or frame that does not exist.
        Cancelled: The work was stopped.

    Source: the body is a factor graph of bones in continuous time (white noise on acceleration:
        T. D. Barfoot, C. H. Tong, S. Särkkä, "Batch continuous-time trajectory estimation as exactly
        sparse Gaussian process regression", RSS 2014).
    """
    # This import is inside the function because the import of gtsam takes a second.
    from bodycap_batch.merging.stage import merge

    return merge(inputs, options, context)
