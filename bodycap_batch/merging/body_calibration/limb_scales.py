"""Estimate a separate scale for each limb.

This is a diagnostic: equal scales show that the bone lengths of the limbs are consistent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.optimize import minimize_scalar

from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import (
    MIN_COMMON_FRAMES,
    PostureHints,
    count_common_frames,
    sample_subset,
)
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import split_side

_LOG_SCALE_STEP = 0.1
"""Step of log scale between the three trial scales. Evidence: none.

Each limb is calibrated at three trial scales. A parabola through the three costs gives the scale of the limb.
"""
_MAX_LOG_RATIO = 1.5
"""Largest logarithm of the ratio of a limb's scale to that of the body. The part of a map that is four times
too large is inside. Evidence: none."""
_SAMPLES = 40
"""Maximum number of sampled times in a limb's calibration: half of the number for the whole body.

Evidence: none.
"""
_LIMB_OF_PART = {
    **dict.fromkeys(("Shoulder", "Arm", "ForeArm", "Hand"), "arm"),
    **dict.fromkeys(("UpLeg", "Leg", "Foot", "ToeBase"), "leg"),
    **dict.fromkeys(("Neck", "Head"), "head"),
}


def limb_scales(
    skeleton: SkeletonModel,
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    scale: float,
    hints: PostureHints,
    step: Callable[[], None],
) -> tuple[ScaleSource, ...]:
    """Estimate a scale for each limb from the cameras of this limb and the reference camera.

    These scales are a diagnostic: the report shows them, and nothing else uses them. For each limb, a small
    calibration graph is solved three times.

    Args:
        skeleton: The skeleton of the body.
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks. The track of the reference camera is the first.
        scale: The scale of the whole body, metres per map unit.
        hints: Facts about the posture that are known before the calibration.
        step: Function that is called after each iteration. It may raise an exception to stop the work.

    Returns:
        One scale per limb. Limbs that do not determine a scale are missing. Cameras that share too few frames
        with the reference camera are not used. The result is empty if fewer than two limbs have usable
        cameras.
    """
    limbs: dict[str, list[CameraTrack]] = {}
    for track in tracks[1:]:
        side, part = split_side(mounts[track.camera].role)
        if part in _LIMB_OF_PART and count_common_frames(tracks[0], track) >= MIN_COMMON_FRAMES:
            limbs.setdefault(f"{side.lower()} {_LIMB_OF_PART[part]}".strip(), []).append(track)
    if len(limbs) < 2:
        return ()
    found = []
    for name, own in sorted(limbs.items()):
        subset = sample_subset(skeleton, mounts, [tracks[0], *own], scale, _SAMPLES, hints)
        graph = CalibrationGraph(skeleton, subset.bones, subset.samples, mounts, scale, step)
        graph.solve(scale)
        found.append(_scale_of_limb(name, graph, scale))
    return tuple(source for source in found if source is not None)


def _scale_of_limb(name: str, graph: CalibrationGraph, scale: float) -> ScaleSource | None:
    """Return the scale at the minimum of a parabola through the costs of three scales.

    The middle scale has a lower cost than the two others: a parabola says nothing about scales that are far
    from the three. So the search goes downhill first, with steps that double.

    Args:
        name: Name of the limb.
        graph: The calibration graph of the limb.
        scale: The scale at which the search starts, metres per map unit.

    Returns:
        The scale of the limb; None if the cost has no minimum within the searched scales.
    """
    costs: dict[float, float] = {}

    def cost(log_ratio: float) -> float:
        if log_ratio not in costs:
            costs[log_ratio] = graph.solve(scale * float(np.exp(log_ratio)))
        return costs[log_ratio]

    centre = 0.0
    if cost(0.0) > min(cost(-_LOG_SCALE_STEP), cost(_LOG_SCALE_STEP)):
        side = 1.0 if cost(_LOG_SCALE_STEP) < cost(-_LOG_SCALE_STEP) else -1.0
        before, reached, step = 0.0, side * _LOG_SCALE_STEP, 2.0 * _LOG_SCALE_STEP
        while (after := reached + side * step) and cost(after) < cost(reached):
            if abs(after) > _MAX_LOG_RATIO:
                return None
            before, reached, step = reached, after, 2.0 * step
        bounds = min(before, after), max(before, after)
        found = minimize_scalar(
            cost, bounds=bounds, method="bounded", options={"xatol": 0.2 * _LOG_SCALE_STEP}
        )
        centre = float(found.x)
    low, middle, high = (cost(centre + sign * _LOG_SCALE_STEP) for sign in (-1.0, 0.0, 1.0))
    curvature = low + high - 2.0 * middle
    if curvature <= 0.0:
        return None
    offset = 0.5 * _LOG_SCALE_STEP * (low - high) / curvature
    return ScaleSource(
        name=name,
        scale=scale * float(np.exp(centre + offset)),
        sigma_log=float(_LOG_SCALE_STEP / np.sqrt(curvature)),
    )
