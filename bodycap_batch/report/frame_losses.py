"""Find the intervals of lost frames, measure sharpness and rotation near them, and name the likely cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.frame_pictures import FrameAppearance
from bodycap_batch.report.loss_causes import FAST_DEG, PLAIN_RATIO, LossCause
from bodycap_batch.report.report_inputs import ReportInputs

_NEIGHBOURS = 3
"""Number of frame pairs on each side of a lost interval in which the rotation is measured.

Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLoss:
    """A lost interval: successive frames of one camera without a pose.

    Attributes:
        camera: Camera name.
        first: Index of the first frame.
        last: Index of the last frame.
        start_s: Common time of the first frame, seconds.
        end_s: Common time of the last frame, seconds.
        reason: The most frequent status of the frames.
        sharpness: Ratio of the frames' median sharpness to the median sharpness of the camera's registered
            frames; NaN if unknown.
        turn_deg: Largest rotation between two successive registered frames near the interval, degrees; NaN if
            there are no such frames.
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
        """Number of frames in the interval."""
        return self.last - self.first + 1

    @property
    def middle(self) -> int:
        """Index of the frame in the middle of the interval."""
        return (self.first + self.last) // 2


def find_frame_losses(inputs: ReportInputs) -> list[FrameLoss]:
    """Return the lost intervals of all registered cameras, camera by camera."""
    return [
        loss
        for registration in inputs.registrations
        for loss in _camera_losses(inputs, registration.trajectory)
    ]


_CAUSES_OF_REASONS = {
    FrameStatus.CONTRADICTED: LossCause.CONTRADICTED,
    FrameStatus.NO_MAP: LossCause.NO_MAP,
    FrameStatus.OTHER_MAP: LossCause.OTHER_MAP,
    FrameStatus.ROTATION_ONLY: LossCause.ROTATION_ONLY,
    FrameStatus.DAMAGED: LossCause.DAMAGED,
    FrameStatus.FROZEN: LossCause.FROZEN,
}
"""Cause of a loss, for the reasons that determine the cause."""


def likely_cause(
    loss: FrameLoss, appearance: FrameAppearance | None, usual_corners: float | None
) -> LossCause:
    """Return the likely cause of a lost interval.

    Args:
        loss: The lost interval.
        appearance: Measurements of the interval's middle frame; None if this frame was not decoded.
        usual_corners: Median number of corners in the camera's registered frames; None if unknown.
    """
    if loss.reason in _CAUSES_OF_REASONS:
        return _CAUSES_OF_REASONS[loss.reason]
    if appearance is not None and appearance.is_dark:
        return LossCause.DARK
    if loss.turn_deg > FAST_DEG:
        return LossCause.FAST
    if loss.reason is FrameStatus.BLUR:
        return LossCause.BLUR
    if loss.reason is FrameStatus.UNCONSTRAINED:
        return LossCause.SHALLOW
    if appearance is not None and usual_corners and appearance.corners < PLAIN_RATIO * usual_corners:
        return LossCause.PLAIN
    return LossCause.BLUR if loss.sharpness < BLUR_SHARPNESS_RATIO else LossCause.UNKNOWN_PLACE


def turn_per_frame_deg(trajectory: Trajectory) -> FloatArray:
    """Return the rotation angle (N−1,) between each frame and the next frame, degrees.

    The angle is NaN if one of the two frames has no pose.
    """
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
