"""Stage 4: fit a skeleton to the cameras' trajectories, in metres, z up. Only this package imports gtsam."""

from __future__ import annotations

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.merge_data import MergeInputs, MergeResult

__all__ = ["merge_trajectories"]


def merge_trajectories(inputs: MergeInputs, options: MergeOptions, context: StageContext) -> MergeResult:
    """Estimate mounts, metric scale, world frame and the body's motion from the cameras' trajectories.

    Args:
        inputs: Trajectories in the gauges of their maps, clocks, skeleton and mount priors.
        options: Options of the stage, among them the rate of the timeline.
        context: Progress and cancellation, both used between the optimiser's iterations.

    Raises:
        EstimationError: Too few frames were localised, or nothing determines the scale.
        JobError: The job names a camera or frame that does not exist.
        Cancelled: The work was stopped.

    Source: the body is a factor graph of bones in continuous time (white noise on acceleration:
        T. D. Barfoot, C. H. Tong, S. Särkkä, "Batch continuous-time trajectory estimation as exactly
        sparse Gaussian process regression", RSS 2014).
    """
    # gtsam takes a second to import.
    from bodycap_batch.merging.stage import merge

    return merge(inputs, options, context)
