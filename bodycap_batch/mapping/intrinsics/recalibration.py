"""Build the map again with refined intrinsics if the first map contradicts the given calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.map_diagnostics import RefinedIntrinsics
from bodycap_batch.model.scene import Map, MapResult

_MIN_KEYFRAME_RATIO = 0.95
"""Minimum ratio of the number of keyframes in a new map to the number of keyframes in the first map. A new
map with a smaller ratio is not better. The ratio is computed for all cameras together and for each camera.
Evidence: none."""

_MAX_FOCAL_FACTOR = 3.0
"""Maximum factor between a given focal length and the one that a map determines. Origin: the fields of view
of one camera differ by less (narrow and wide: 2.2). A larger factor is a lens that the map does not
determine. Evidence: docs/decisions/mapping.md."""


def recalibrate_if_misfit(
    result: MapResult,
    capture: Capture,
    build: Callable[[Capture], MapResult],
    refused: EstimationError | None = None,
) -> MapResult:
    """Build the map again with refined intrinsics if the map contradicts the given intrinsics of a camera.

    Evidence: docs/decisions/mapping.md.

    Args:
        result: The map that was built with constant calibrated intrinsics. Its diagnostics name the cameras
            whose given intrinsics contradict the map (`misfit_factors`).
        capture: All cameras.
        build: Function that builds a map of a capture with changed intrinsics.
        refused: The reason why `result` is unusable; None if it is usable. Wrong intrinsics may be the cause.

    Returns:
        The new map if it is better than `result`, else `result`.

    Raises:
        EstimationError: `refused`, if it is given and there is no better map.
    """
    refined = _recalibrate(result, capture, build, usable=refused is None)
    if refused is not None and not refined.diagnostics.recalibrated:
        raise refused
    return refined


def _recalibrate(
    result: MapResult, capture: Capture, build: Callable[[Capture], MapResult], *, usable: bool
) -> MapResult:
    """Return the map with refined intrinsics if it is better, else the given map.

    The log of the returned map reports the decision.

    Args:
        result: The given map.
        capture: All cameras.
        build: Function that builds a map of a capture with changed intrinsics.
        usable: Whether the given map is usable. A better map always contains all cameras whose given
            intrinsics contradict the given map. If the given map is usable, a better map also passes
            `_is_better_map`. Its lenses must be possible ones (`_is_possible`).
    """
    misfits = result.diagnostics.misfit_factors or {}
    if not misfits or not is_on(Mechanism.RECALIBRATION):
        return result
    given = {name: capture.camera(name).camera for name in misfits}
    guesses = {name: _initial_guess(given[name], misfits[name]) for name in misfits}
    try:
        again = build(with_intrinsics_to_refine(capture, guesses))
    except EstimationError as error:
        return replace(result, log={**result.log, "freeing_failed": error.message})
    other = again.maps[0]
    is_better = misfits.keys() <= other.cameras.keys() and (
        not usable or _is_better_map(other, result.maps[0])
    )
    if not is_better or not all(_is_possible(other.cameras[name], given[name]) for name in misfits):
        comparison = {"keyframes": _count_keyframes(other), "mean_error_px": round(other.mean_error_px(), 4)}
        return replace(result, log={**result.log, "freeing_refused": comparison})
    cameras = {name: other.cameras[name] for name in sorted(misfits)}
    factors = {name: round(camera.focal_px / given[name].focal_px, 3) for name, camera in cameras.items()}
    diagnostics = again.diagnostics
    diagnostics = replace(
        diagnostics,
        misfit_factors={**(diagnostics.misfit_factors or {}), **factors},
        recalibrated=tuple(cameras),
        refined_intrinsics={
            name: RefinedIntrinsics(camera.model, tuple(camera.params.tolist()))
            for name, camera in cameras.items()
        },
    )
    return replace(again, log=diagnostics.to_log())


def with_map_intrinsics(capture: Capture, previous: MapResult) -> Capture:
    """Return the capture with the intrinsics that were refined with an earlier map of the same capture.

    If the earlier map has no keyframes of a camera, the camera's refined intrinsics are read from the map's
    diagnostics.
    """
    mapped = previous.maps[0].cameras
    cameras = {
        name: mapped[name] if name in mapped else _with_intrinsics(capture.camera(name).camera, refined)
        for name, refined in previous.diagnostics.refined_intrinsics.items()
    }
    return with_intrinsics_to_refine(capture, cameras)


def _with_intrinsics(camera: Camera, refined: RefinedIntrinsics) -> Camera:
    """Return the camera with the refined camera model and its parameters."""
    return replace(camera, model=refined.model, params=np.array(refined.params))


def with_intrinsics_to_refine(capture: Capture, cameras: Mapping[str, Camera]) -> Capture:
    """Return the capture with new initial intrinsics for some cameras, to be refined in mapping.

    Args:
        capture: All cameras.
        cameras: The new initial intrinsics, by camera name.
    """
    return replace(
        capture,
        cameras=tuple(
            replace(
                item,
                camera=replace(cameras[item.name], sideways=item.camera.sideways),
                calibrated=False,
                lens_sigma=0.0,
                given=item.given or item.camera,
            )
            if item.name in cameras
            else item
            for item in capture.cameras
        ),
    )


def _initial_guess(camera: Camera, factor: float) -> Camera:
    """Return initial intrinsics with the focal length that fits the map, and with zero distortion.

    The returned camera model has one radial term, because the mapper estimates the distortion again. A model
    without distortion would not fit the images of a lens with barrel distortion.
    Evidence: docs/decisions/mapping.md.

    Args:
        camera: The given intrinsics.
        factor: Ratio of the focal length that fits the map to the given focal length.
    """
    centre_x, centre_y = camera.principal_point_px
    params = np.array([factor * camera.focal_px, centre_x, centre_y, 0.0])
    return Camera(
        model="SIMPLE_RADIAL",
        width_px=camera.width_px,
        height_px=camera.height_px,
        params=params,
        refine=True,
    )


def _is_possible(refined: Camera, given: Camera) -> bool:
    """Return whether a camera with a given lens may have the refined one in another mode."""
    factor = refined.focal_px / given.focal_px
    return 1.0 / _MAX_FOCAL_FACTOR < factor < _MAX_FOCAL_FACTOR


def _is_better_map(other: Map, one: Map) -> bool:
    """Return whether the map `other` is better than the map `one`.

    A better map has a smaller mean reprojection error and almost as many keyframes, in total and of each
    camera.
    """
    counts, before = _count_keyframes(other), _count_keyframes(one)
    enough = sum(counts.values()) >= _MIN_KEYFRAME_RATIO * sum(before.values())
    enough_of_each = all(
        counts.get(name, 0) >= max(1, int(_MIN_KEYFRAME_RATIO * count)) for name, count in before.items()
    )
    return enough and enough_of_each and other.mean_error_px() < one.mean_error_px()


def _count_keyframes(scene_map: Map) -> dict[str, int]:
    """Return the number of keyframes of each camera in a map."""
    return dict(sorted(Counter(scene_map.keyframe_camera).items()))
