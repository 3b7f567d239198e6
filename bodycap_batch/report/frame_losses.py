"""Intervals of lost frames, with measurements in them and next to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.frame_pictures import FrameAppearance
from bodycap_batch.report.report_inputs import ReportInputs

_FAST_DEG = 8.0
"""Degrees from one frame to the next.

Optical flow loses most tracks above 20 degrees, and motion blur starts at much smaller angles.
"""
_PLAIN_RATIO = 0.3
"""Corners relative to the camera's registered frames below which surfaces are plain. Evidence: none."""
_NEIGHBOURS = 3
"""Frame pairs before and after a lost interval in which the rotation is measured. Evidence: none."""


class LossCause(StrEnum):
    """The likely cause of a lost interval, as far as it can be measured."""

    DARK = "too dark"
    FAST = "fast turn"
    BLUR = "motion blur"
    PLAIN = "plain surfaces"
    SHALLOW = "points too far away or too close together"
    UNKNOWN_PLACE = "place not in the map"
    NO_MAP = "no map for this camera"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLoss:
    """Successive frames without a pose.

    Attributes:
        camera: Camera name.
        first: Index of the first frame.
        last: Index of the last frame.
        start_s: Common time of the first frame.
        end_s: Common time of the last frame.
        reason: The most frequent status of the frames.
        sharpness: Median sharpness relative to the median of the registered frames; NaN if unknown.
        turn_deg: Largest rotation per frame next to the interval, degrees; NaN if no two successive frames
            there are registered.
    """

    camera: str
    first: int
    last: int
    start_s: float
    end_s: float
    reason: FrameStatus
    sharpness: float
    turn_deg: float

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.last - self.first + 1

    @property
    def middle(self) -> int:
        """Index of the middle frame."""
        return (self.first + self.last) // 2


def find_frame_losses(inputs: ReportInputs) -> list[FrameLoss]:
    """Return every interval of lost frames, camera by camera."""
    return [
        loss
        for registration in inputs.registrations
        for loss in _camera_losses(inputs, registration.trajectory)
    ]


def likely_cause(
    loss: FrameLoss, appearance: FrameAppearance | None, usual_corners: float | None
) -> LossCause:
    """Return the likely cause of a lost interval.

    Args:
        loss: The interval.
        appearance: Its middle frame; None if it was not decoded.
        usual_corners: Corners in the camera's registered frames; None if there are none to compare with.
    """
    if loss.reason is FrameStatus.NO_MAP:
        return LossCause.NO_MAP
    if appearance is not None and appearance.is_dark:
        return LossCause.DARK
    if loss.turn_deg > _FAST_DEG:
        return LossCause.FAST
    if loss.reason is FrameStatus.BLUR:
        return LossCause.BLUR
    if loss.reason is FrameStatus.UNCONSTRAINED:
        return LossCause.SHALLOW
    if appearance is not None and usual_corners and appearance.corners < _PLAIN_RATIO * usual_corners:
        return LossCause.PLAIN
    return LossCause.BLUR if loss.sharpness < BLUR_SHARPNESS_RATIO else LossCause.UNKNOWN_PLACE


def turn_per_frame_deg(trajectory: Trajectory) -> FloatArray:
    """Return the rotation (N−1,) from each frame to the next, degrees; NaN if one of them has no pose."""
    rotation, localised = trajectory.gauge_from_cam[:, :3, :3], trajectory.localised
    both = localised[:-1] & localised[1:]
    turn_deg = np.full(max(len(localised) - 1, 0), np.nan)
    frame_from_next = np.swapaxes(rotation[:-1][both], -1, -2) @ rotation[1:][both]
    turn_deg[both] = np.degrees(rotation_angle_rad(frame_from_next))
    return turn_deg


def _camera_losses(inputs: ReportInputs, path: Trajectory) -> Iterator[FrameLoss]:
    lost = ~path.localised
    times = common_times_s(inputs, path.camera, path.times_ns)
    selection = inputs.selection(path.camera)
    sharpness = None if selection is None or lost.all() else selection.sharpness
    usual_sharpness = np.nan if sharpness is None else float(np.median(sharpness[~lost]))
    turns = turn_per_frame_deg(path)
    for first, stop in runs(lost):
        adjacent = np.concatenate(
            [turns[max(0, first - _NEIGHBOURS) : first], turns[stop - 1 : stop - 1 + _NEIGHBOURS]]
        )
        adjacent = adjacent[np.isfinite(adjacent)]
        reasons = Counter(path.status[first:stop])
        yield FrameLoss(
            camera=path.camera,
            first=first,
            last=stop - 1,
            start_s=float(times[first]),
            end_s=float(times[stop - 1]),
            reason=reasons.most_common(1)[0][0],
            sharpness=float(np.median(sharpness[first:stop])) / usual_sharpness
            if sharpness is not None and usual_sharpness > 0
            else float("nan"),
            turn_deg=float(adjacent.max()) if len(adjacent) else float("nan"),
        )
