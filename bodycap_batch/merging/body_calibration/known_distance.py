"""Metric scale from a known distance: the job gives the distance between two camera centres.

The two centres belong to two frames of one camera or of two cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.core.percent import format_percent
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.cameras.track import MIN_SIGMA_M
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Trajectory

_FIELD = "merge.known_distance"
_MIN_SIGMA = 0.003
"""Relative sigma of the distance that the job gives. Evidence: none.

A person measures the distance between two lenses with an error of a few millimetres per metre.
"""
_MIN_SIGNAL_TO_NOISE = 10.0
"""Minimum distance between the two camera centres in the map, in sigmas. Evidence: none.

The sigma is the uncertainty of the difference of the two centres, per axis.
"""


def known_distance(
    trajectories: Sequence[Trajectory],
    stated: tuple[str, str, float] | None,
    main_from_gauge: Mapping[str, Similarity],
) -> ScaleSource | None:
    """Return the scale from the known distance of the job.

    Args:
        trajectories: The cameras' trajectories, each in the gauge of its map.
        stated: Two frames as ``camera:frame``, and the distance between their camera centres in metres. None
            if the job gives no distance.
        main_from_gauge: By gauge of each used map, similarity from this map to the main map.

    Returns:
        The scale of the main map; None if the job gives no distance.

    Raises:
        JobError: A camera or a frame does not exist, or the two cameras are in different maps.
        EstimationError: A frame was not localised, the two centres are too near to each other, or the map of
            the two cameras was not aligned to the main map.
    """
    if stated is None:
        return None
    first, second, metres = stated
    ends = [_find_frame(trajectories, name) for name in (first, second)]
    gauge = ends[0].gauge
    if ends[1].gauge != gauge:
        raise JobError(
            f"the frames {first} and {second} are in different maps that have no place in common",
            field=_FIELD,
            hint="choose two frames of one camera",
        )
    if gauge not in main_from_gauge:
        raise EstimationError(
            f"the frames {first} and {second} are in map {gauge}, which was not aligned with the main map",
            hint="choose two frames of a camera that is used; metrics.json lists the unused cameras",
        )
    variance = sum(end.centre_variance for end in ends)
    distance = float(np.linalg.norm(ends[1].centre - ends[0].centre))
    if distance**2 <= _MIN_SIGNAL_TO_NOISE**2 * variance:
        raise EstimationError(
            f"the camera positions in the frames {first} and {second} are too close to each other: the "
            f"uncertainty is {format_percent(np.sqrt(variance) / max(distance, 1e-12))} of their distance",
            hint="choose two frames in which the camera positions are farther apart",
        )
    sigma = np.sqrt(variance / distance**2 + 2.0 * (MIN_SIGMA_M / metres) ** 2 + _MIN_SIGMA**2)
    return ScaleSource(
        name="known distance",
        scale=metres / (main_from_gauge[gauge].scale * distance),
        sigma_log=float(sigma),
    )


class _End(NamedTuple):
    """One end of the known distance: gauge, camera centre (3,) in this gauge, and its variance per axis."""

    gauge: str
    centre: FloatArray
    centre_variance: float


def _find_frame(trajectories: Sequence[Trajectory], name: str) -> _End:
    """Return the camera centre of the frame with the name ``camera:frame``."""
    camera, _, number = name.rpartition(":")
    found = next((each for each in trajectories if each.camera == camera), None)
    if found is None:
        raise JobError(
            f"there is no camera {camera!r}",
            field=_FIELD,
            hint=f"use one of the cameras {', '.join(each.camera for each in trajectories)}",
        )
    # A frame that is a copy of the frame before has no number of its own.
    row = int(np.searchsorted(found.frame_numbers, int(number), side="right")) - 1
    if row < 0 or int(number) > found.frame_numbers[-1] + 1:
        raise JobError(
            f"camera {camera} has no frame {number}",
            field=_FIELD,
            hint="choose a frame of the video; the first frame is 0",
        )
    if not found.localised[row]:
        raise EstimationError(
            f"frame {name} of the known distance was not localised: {found.status[row].name}",
            hint="choose a frame that was localised; frames.csv lists the status of each frame",
        )
    variance = float(np.trace(found.covariance[row, 3:, 3:])) / 3.0
    return _End(found.gauge, found.gauge_from_cam[row, :3, 3], variance)
