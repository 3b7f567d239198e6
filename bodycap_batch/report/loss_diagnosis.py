"""Diagnose the likely cause of each lost interval from the measurements and from a frame's image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import evenly_spaced
from bodycap_batch.core.context import StageContext
from bodycap_batch.report.frame_losses import FrameLoss, find_frame_losses, likely_cause
from bodycap_batch.report.frame_pictures import FrameAppearance, measure_appearance
from bodycap_batch.report.loss_causes import LossCause, LostSpan
from bodycap_batch.report.report_inputs import ReportInputs

_REFERENCE_FRAMES = 5
"""Number of registered frames of each camera that are compared with the camera's lost frames.

Evidence: none.
"""
_MAX_PICTURES = 24
"""Maximum number of lost intervals of each camera from which a frame is decoded.

The page shows at most this number of pictures of lost frames, for all cameras together.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosedLoss:
    """A lost interval with its likely cause and the appearance of its middle frame.

    Attributes:
        loss: The lost interval.
        cause: The likely cause of the loss.
        appearance: Appearance of the interval's middle frame; None if this frame was not decoded.
    """

    loss: FrameLoss
    cause: LossCause
    appearance: FrameAppearance | None


def diagnose_losses(inputs: ReportInputs, context: StageContext) -> list[DiagnosedLoss]:
    """Return every lost interval with its likely cause.

    The middle frame is decoded only for the longest lost intervals of each camera.
    """
    losses = find_frame_losses(inputs)
    diagnosed = []
    for name in inputs.cameras:
        camera_losses = [loss for loss in losses if loss.camera == name]
        longest = sorted(camera_losses, key=lambda loss: -loss.frame_count)[:_MAX_PICTURES]
        appearances, usual_corners = _measure_frames(inputs, name, longest, context)
        diagnosed += [
            DiagnosedLoss(
                loss=loss,
                cause=likely_cause(loss, appearances.get(loss.middle), usual_corners),
                appearance=appearances.get(loss.middle),
            )
            for loss in camera_losses
        ]
    return diagnosed


def _measure_frames(
    inputs: ReportInputs, camera: str, losses: Sequence[FrameLoss], context: StageContext
) -> tuple[dict[int, FrameAppearance], float | None]:
    """Measure the middle frames of lost intervals, and a few registered frames of the same camera.

    Returns:
        The appearance of each measured frame, by frame index; and the median number of corners in the
        registered frames, None if no registered frame was measured.
    """
    path = inputs.path(camera)
    if not losses or path is None or inputs.capture is None:
        return {}, None
    localised = np.flatnonzero(path.localised)
    reference = [int(localised[index]) for index in evenly_spaced(len(localised), _REFERENCE_FRAMES)]
    indices = [*(loss.middle for loss in losses), *reference]
    appearances = measure_appearance(inputs.capture.camera(camera), indices, context)
    corners = [appearances[index].corners for index in reference if index in appearances]
    return appearances, float(np.median(corners)) if corners else None


def spans_of(losses: Sequence[DiagnosedLoss]) -> tuple[LostSpan, ...]:
    """Return the lost intervals in the form that the verdict uses."""
    return tuple(
        LostSpan(
            camera=diagnosed.loss.camera,
            from_s=diagnosed.loss.start_s,
            to_s=diagnosed.loss.end_s,
            frames=diagnosed.loss.frame_count,
            cause=diagnosed.cause,
        )
        for diagnosed in losses
    )


def count_frames_by_cause(losses: Sequence[DiagnosedLoss]) -> dict[str, Counter[LossCause]]:
    """Return the number of lost frames by camera and cause."""
    counts: dict[str, Counter[LossCause]] = {}
    for diagnosed in losses:
        by_cause = counts.setdefault(diagnosed.loss.camera, Counter())
        by_cause[diagnosed.cause] += diagnosed.loss.frame_count
    return counts
