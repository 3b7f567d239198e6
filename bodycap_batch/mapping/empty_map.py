"""The map of a capture that shows no place: it holds the lenses alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.inputs import with_estimated_lenses
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.scene import KeyframeSelection, Map, MapResult

_GAUGE = "no-map"
"""Gauge of rotations without a map."""


def empty_map(
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    context: StageContext,
    failure: EstimationError,
) -> MapResult:
    """Return a map without keyframes and points, with the lenses that are known without a map.

    Args:
        capture: All cameras.
        selections: The keyframes of the cameras, with the lens that their tracks determine.
        context: Work folder.
        failure: Why there is no map, for the log.
    """
    workspace = context.work_dir / "empty"
    workspace.mkdir(parents=True, exist_ok=True)
    cameras = with_estimated_lenses(capture, selections).cameras
    nothing = np.zeros(0, dtype=np.int64)
    scene = Map(
        gauge=_GAUGE,
        cameras={each.name: each.camera for each in cameras},
        keyframe_camera=(),
        keyframe_frame=nothing,
        map_from_cam=np.zeros((0, 4, 4)),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), dtype=np.uint8),
        point_error_px=np.zeros(0),
        obs_keyframe=nothing,
        obs_point=nothing,
        obs_feature=nothing,
        obs_px=np.zeros((0, 2)),
    )
    log = {"failure": {"message": failure.message, "hint": failure.hint}}
    return MapResult(maps=(scene,), workspace=workspace, log=MapDiagnostics(details=log).to_log())
