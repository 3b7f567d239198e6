"""Stage 4: camera paths onto one skeleton, in metres, gravity up. The only room that imports gtsam."""

from __future__ import annotations

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.merge_data import MergeInputs, MergeResult

__all__ = ["merge_trajectories"]


def merge_trajectories(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """Solve mounts, metric scale, the world's axes and the body's motion from the cameras' paths.

    Args:
        inputs: Trajectories in their maps' gauges, clocks, skeleton and mount priors.
        options: Rate of the timeline and the longest gap filled without a mark.
        context: Progress and cancellation, asked between the optimiser's iterations.

    Raises:
        EstimationError: Too few frames were localised, or nothing fixes the scale.
        Cancelled: The work was stopped.

    Source: the body as a factor graph of bones in continuous time (white noise on acceleration:
        T. D. Barfoot, C. H. Tong, S. Särkkä, "Batch continuous-time trajectory estimation as exactly
        sparse Gaussian process regression", RSS 2014).
    """
    # gtsam takes a second to import.
    from bodycap_batch.merging.stage import merge

    return merge(inputs, options, context)
