"""Given lenses that the map contradicts: the map is built again with these to be found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bodycap_batch.camera import Camera
from bodycap_batch.capture import Capture
from bodycap_batch.errors import EstimationError
from bodycap_batch.scene import Map, MapResult

FREED = "freed_lenses"
"""The log's list of cameras whose given lens was replaced by what fits the pictures."""

_AS_MANY = 0.95


def freed_where_contradicted(
    result: MapResult, capture: Capture, build: Callable[[Capture], MapResult]
) -> MapResult:
    """The map with misfitting lenses found along with it, where that is the better map.

    Cameras 31 % off (digital zoom in one of three) put all three 41 cm off, 25 % in all of them 9 cm.

    Args:
        result: The map with all lenses held as given; ``misfitting_lenses`` of its log says which it
            contradicts.
        capture: All cameras.
        build: Builds a map of the capture with other lenses.
    """
    misfits: Mapping[str, float] = result.log["misfitting_lenses"]
    if not misfits:
        return result
    given = {name: capture.camera(name).camera for name in misfits}
    try:
        again = build(
            with_free_lenses(capture, {name: _unknown(given[name], misfits[name]) for name in misfits})
        )
    except EstimationError as error:
        return replace(result, log={**result.log, "freeing_failed": error.message})
    if not _better(again.maps[0], result.maps[0]):
        return result
    found = {
        name: round(again.maps[0].cameras[name].focal_px / lens.focal_px, 3)
        for name, lens in given.items()
        if name in again.maps[0].cameras
    }
    told = {**again.log["misfitting_lenses"], **found}
    return replace(again, log={**again.log, "misfitting_lenses": told, FREED: sorted(found)})


def as_mapped(capture: Capture, previous: MapResult) -> Capture:
    """The capture with the lenses that an earlier map of it freed as that map found them."""
    lenses = previous.maps[0].cameras
    return with_free_lenses(capture, {name: lenses[name] for name in previous.log.get(FREED, ())})


def with_free_lenses(capture: Capture, lenses: Mapping[str, Camera]) -> Capture:
    """The capture with some cameras' lenses as a start that mapping refines."""
    cameras = tuple(
        replace(each, camera=lenses[each.name], calibrated=False) if each.name in lenses else each
        for each in capture.cameras
    )
    return replace(capture, cameras=cameras)


def _unknown(lens: Camera, factor: float) -> Camera:
    """A lens of which only the focal length that fits is known: its distortion is not believed either.

    A barrel lens given as a pinhole seemed 1.6 to 1.9 times as long; from there focal length and both radial
    terms were found to half a percent (53 cm to 1 cm), while a longer pinhole fitted nothing.
    """
    centre_x, centre_y = lens.principal_point_px
    params = np.array([factor * lens.focal_px, centre_x, centre_y, 0.0])
    return Camera(
        model="SIMPLE_RADIAL", width_px=lens.width_px, height_px=lens.height_px, params=params, refine=True
    )


def _better(other: Map, one: Map) -> bool:
    """Whether another map holds hardly fewer keyframes, and lies nearer to what they see."""
    many = len(other.keyframe_camera) >= _AS_MANY * len(one.keyframe_camera)
    return many and other.mean_error_px() < one.mean_error_px()
