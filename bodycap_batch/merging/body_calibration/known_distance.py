"""A distance the job states: how far a camera went between two of its frames, or two cameras were apart."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.cameras.track import MIN_SIGMA_M
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

_FIELD = "merge.known_distance"
_MIN_SIGMA = 0.003
"""Nobody measures the way between two lenses better than to a few millimetres a metre."""


def known_distance(
    inputs: MergeInputs, options: MergeOptions, places: Mapping[str, Similarity] | None = None
) -> ScaleSource | None:
    """The scale from the job's known distance, None where it states none.

    Args:
        inputs: The trajectories, each in its own map's gauge.
        options: ``known_distance``.
        places: By gauge, where each used map lies in the main one; None where all are in one map.

    Raises:
        JobError: It names a camera or frame that is not there, or the two cameras share no map.
        EstimationError: One of the frames was not localised, or both are at the same place, or in a map that
            was not placed in the main one.
    """
    if options.known_distance is None:
        return None
    first, second, metres = options.known_distance
    ends = [_find_frame(inputs, name) for name in (first, second)]
    if ends[0][0].gauge != ends[1][0].gauge:
        raise JobError(
            f"{first} and {second} are in maps that share no view",
            field=_FIELD,
            hint="name two frames of one camera",
        )
    gauge = ends[0][0].gauge
    if places is not None and gauge not in places:
        raise EstimationError(
            f"{first} and {second} are in map {gauge}, which the body cannot place",
            hint="name two frames of a camera that is used; metrics.json tells which are not",
        )
    unit = 1.0 if places is None else places[gauge].scale
    centres = [trajectory.gauge_from_cam[index, :3, 3] for trajectory, index in ends]
    variance = sum(float(np.trace(trajectory.covariance[index, 3:, 3:])) / 3.0 for trajectory, index in ends)
    apart = float(np.linalg.norm(centres[1] - centres[0]))
    if apart**2 <= 100.0 * variance:
        raise EstimationError(
            f"{first} and {second} are too near to each other: {np.sqrt(variance) / max(apart, 1e-12):.0%} "
            "of their distance is uncertain",
            hint="name two frames that are farther apart",
        )
    sigma = np.sqrt(variance / apart**2 + 2.0 * (MIN_SIGMA_M / metres) ** 2 + _MIN_SIGMA**2)
    return ScaleSource(name="known distance", scale=metres / (unit * apart), sigma_log=float(sigma))


def _find_frame(inputs: MergeInputs, name: str) -> tuple[Trajectory, int]:
    """Trajectory and row of ``camera:frame``."""
    camera, _, number = name.rpartition(":")
    found = next((each for each in inputs.trajectories if each.camera == camera), None)
    if found is None:
        raise JobError(
            f"there is no camera {camera!r}",
            field=_FIELD,
            hint=f"cameras: {', '.join(each.camera for each in inputs.trajectories)}",
        )
    rows = np.flatnonzero(found.frame_numbers == int(number))
    if not len(rows):
        raise JobError(f"{camera} has no frame {number}", field=_FIELD, hint="frames are counted from 0")
    if not found.localised[rows[0]]:
        raise EstimationError(
            f"frame {name} of the known distance was not localised: {found.status[rows[0]].name}",
            hint="name another frame; frames.csv tells which were",
        )
    return found, int(rows[0])
