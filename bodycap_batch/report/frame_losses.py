"""Find the spans of lost frames, measure sharpness and rotation near them, and name the likely cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, evenly_spaced, runs
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.frame_pictures import FrameAppearance, measure_appearance
from bodycap_batch.report.loss_causes import FAST_DEG, PLAIN_RATIO, LossCause, LostSpan
from bodycap_batch.report.report_inputs import ReportInputs

_NEIGHBOURS = 3
"""Number of frame pairs on each side of a lost span in which the rotation is measured. Evidence: none."""
_REFERENCE_FRAMES = 5
"""Number of registered frames of each camera that are compared with the camera's lost frames.

Evidence: none.
"""
MAX_LOSS_PICTURES = 24
"""Maximum number of pictures of lost frames on the page: six rows of four pictures on a wide screen. Of each
camera, no more frames are decoded."""


def diagnose_losses(inputs: ReportInputs, context: StageContext) -> list[LostSpan]:
    """Return the lost spans of all registered cameras with their likely causes, camera by camera.

    The middle frame is decoded only for the longest spans of each camera.
    """
    losses = find_losses(inputs)
    diagnosed = []
    for name in inputs.cameras:
        spans = [loss for loss in losses if loss.camera == name]
        longest = sorted(spans, key=lambda span: -span.frames)[:MAX_LOSS_PICTURES]
        appearances, usual_corners = _measure_frames(inputs, name, longest, context)
        for span in spans:
            appearance = appearances.get(span.middle)
            cause = likely_cause(span, appearance, usual_corners)
            diagnosed.append(replace(span, cause=cause, appearance=appearance))
    return diagnosed


def _measure_frames(
    inputs: ReportInputs, camera: str, losses: Sequence[LostSpan], context: StageContext
) -> tuple[dict[int, FrameAppearance], float | None]:
    """Measure the middle frames of lost spans, and a few registered frames of the same camera.

    Returns:
        The appearance of each measured frame, by frame index; and the median number of corners in the
        registered frames, None if no registered frame was measured.
    """
    path = inputs.path(camera)
    if not losses or path is None or inputs.capture is None:
        return {}, None
    localised = np.flatnonzero(path.localised)
    reference = localised[evenly_spaced(len(localised), _REFERENCE_FRAMES)].tolist()
    indices = [*(loss.middle for loss in losses), *reference]
    appearances = measure_appearance(inputs.capture.camera(camera), indices, context)
    corners = [appearances[index].corners for index in reference if index in appearances]
    return appearances, float(np.median(corners)) if corners else None


def find_losses(inputs: ReportInputs) -> list[LostSpan]:
    """Return the lost spans of all registered cameras, without their causes."""
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
    loss: LostSpan, appearance: FrameAppearance | None, usual_corners: float | None
) -> LossCause:
    """Return the likely cause of a lost span.

    Args:
        loss: The lost span.
        appearance: Measurements of the span's middle frame; None if this frame was not decoded.
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


def _camera_losses(inputs: ReportInputs, path: Trajectory) -> Iterator[LostSpan]:
    lost = ~path.localised
    times = common_times_s(inputs, path.camera, path.times_ns)
    selection = inputs.selection(path.camera)
    sharpness = np.full(len(lost), np.nan)
    if (
        selection is not None
        and not lost.all()
        and (usual := float(np.median(selection.sharpness[~lost]))) > 0
    ):
        sharpness = selection.sharpness / usual
    turns = turn_per_frame_deg(path)
    for first, stop in runs(lost):
        adjacent = np.concatenate(
            [turns[max(0, first - _NEIGHBOURS) : first], turns[stop - 1 : stop - 1 + _NEIGHBOURS]]
        )
        adjacent = adjacent[np.isfinite(adjacent)]
        yield LostSpan(
            camera=path.camera,
            first=first,
            frames=stop - first,
            from_s=float(times[first]),
            to_s=float(times[stop - 1]),
            reason=Counter(path.status[first:stop]).most_common(1)[0][0],
            sharpness=float(np.median(sharpness[first:stop])),
            turn_deg=float(adjacent.max()) if len(adjacent) else float("nan"),
        )
