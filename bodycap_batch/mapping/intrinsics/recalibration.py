"""Given lenses that the map contradicts: the map is built again with these to be found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.scene import Map, MapResult

RECALIBRATED = "freed_lenses"
"""The log's list of cameras whose given lens was replaced by what fits the pictures."""

_INTRINSICS = "found_lenses"
"""The log's account of these cameras' lenses: a map that grows may lose all keyframes of one."""
_MIN_KEYFRAME_RATIO = 0.95


def recalibrate_if_misfit(
    result: MapResult,
    capture: Capture,
    build: Callable[[Capture], MapResult],
    refused: EstimationError | None = None,
) -> MapResult:
    """The map with misfitting lenses found along with it, where that is the better map.

    Cameras 31 % off (digital zoom in one of three) put all three 41 cm off, 25 % in all of them 9 cm.

    Args:
        result: The map with all lenses held as given; ``misfitting_lenses`` of its log says which it
            contradicts.
        capture: All cameras.
        build: Builds a map of the capture with other lenses.
        refused: Why that map cannot be used as it is, if it cannot: wrong lenses break maps, too.

    Raises:
        EstimationError: `refused`, where no other lenses give a better map.
    """
    freed = _recalibrate(result, capture, build, usable=refused is None)
    if refused is not None and RECALIBRATED not in freed.log:
        raise refused
    return freed


def _recalibrate(
    result: MapResult, capture: Capture, build: Callable[[Capture], MapResult], *, usable: bool
) -> MapResult:
    misfits: Mapping[str, float] = result.log["misfitting_lenses"]
    if not misfits:
        return result
    given = {name: capture.camera(name).camera for name in misfits}
    try:
        again = build(
            with_intrinsics_to_refine(
                capture, {name: _initial_guess(given[name], misfits[name]) for name in misfits}
            )
        )
    except EstimationError as error:
        return replace(result, log={**result.log, "freeing_failed": error.message})
    other = again.maps[0]
    if not (misfits.keys() <= other.cameras.keys() and (not usable or _is_better_map(other, result.maps[0]))):
        told = {"keyframes": _count_keyframes(other), "mean_error_px": round(other.mean_error_px(), 4)}
        return replace(result, log={**result.log, "freeing_refused": told})
    lenses = {name: other.cameras[name] for name in sorted(misfits)}
    factors = {name: round(lens.focal_px / given[name].focal_px, 3) for name, lens in lenses.items()}
    log = {
        **again.log,
        "misfitting_lenses": {**again.log["misfitting_lenses"], **factors},
        RECALIBRATED: list(lenses),
        _INTRINSICS: {
            name: {"model": lens.model, "params": lens.params.tolist()} for name, lens in lenses.items()
        },
    }
    return replace(again, log=log)


def with_map_intrinsics(capture: Capture, previous: MapResult) -> Capture:
    """The capture with the lenses that an earlier map of it freed as that map found them.

    Of a camera that has no keyframes in it any more, as they were when it was freed.
    """
    held = previous.maps[0].cameras
    lenses = {
        name: held[name]
        if name in held
        else replace(capture.camera(name).camera, **_camera_params_from_log(told))
        for name, told in previous.log.get(_INTRINSICS, {}).items()
    }
    return with_intrinsics_to_refine(capture, lenses)


def _camera_params_from_log(told: Mapping[str, Any]) -> dict[str, Any]:
    """A lens that the log tells of."""
    return {"model": told["model"], "params": np.array(told["params"])}


def with_intrinsics_to_refine(capture: Capture, lenses: Mapping[str, Camera]) -> Capture:
    """The capture with some cameras' lenses as a start that mapping refines."""
    cameras = tuple(
        replace(
            each,
            camera=replace(lenses[each.name], sideways=each.camera.sideways),
            calibrated=False,
        )
        if each.name in lenses
        else each
        for each in capture.cameras
    )
    return replace(capture, cameras=cameras)


def _initial_guess(lens: Camera, factor: float) -> Camera:
    """A lens of which only the focal length that fits is known: its distortion is not believed either.

    A barrel lens given as a pinhole seemed 1.6 to 1.9 times as long; from there focal length and both radial
    terms were found to half a percent (53 cm to 1 cm), while a longer pinhole fitted nothing.
    """
    centre_x, centre_y = lens.principal_point_px
    params = np.array([factor * lens.focal_px, centre_x, centre_y, 0.0])
    return Camera(
        model="SIMPLE_RADIAL", width_px=lens.width_px, height_px=lens.height_px, params=params, refine=True
    )


def _is_better_map(other: Map, one: Map) -> bool:
    """Whether another map holds hardly fewer keyframes, of any camera, and lies nearer to what they see."""
    have, had = _count_keyframes(other), _count_keyframes(one)
    many = sum(have.values()) >= _MIN_KEYFRAME_RATIO * sum(had.values())
    each = all(have.get(name, 0) >= max(1, int(_MIN_KEYFRAME_RATIO * count)) for name, count in had.items())
    return many and each and other.mean_error_px() < one.mean_error_px()


def _count_keyframes(scene_map: Map) -> dict[str, int]:
    """How many keyframes of each camera a map holds."""
    return dict(sorted(Counter(scene_map.keyframe_camera).items()))
