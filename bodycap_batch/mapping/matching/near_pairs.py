"""Distinguish pairs of successive keyframes of one camera from pairs that see a place again.

Two pictures of one camera with little time between them show the same place. If their matches contradict a
map, something moves by itself: a hand, or what it carries. Two pictures with much time between them, or of
different cameras, may show two places that look the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import ImageRef

if TYPE_CHECKING:
    import pycolmap

NEAR_NS = 2_000_000_000
"""Maximum time, nanoseconds, between two keyframes that show the same place. Evidence:
docs/decisions/mapping.md."""
NO_TIMES: Mapping[str, IntArray] = MappingProxyType({})
"""No camera has times: no pair is near."""


def are_near(one: ImageRef, other: ImageRef, times_ns: Mapping[str, IntArray]) -> bool:
    """Return whether two keyframes are of one camera and near in time.

    Args:
        one: A keyframe.
        other: Another keyframe.
        times_ns: Times (N,) of all frames of each camera, nanoseconds, by camera name. No pair of a camera
            without times is near.
    """
    times = times_ns.get(one.camera) if one.camera == other.camera else None
    return times is not None and bool(abs(int(times[one.frame]) - int(times[other.frame])) <= NEAR_NS)


class NearPairs:
    """States which pairs of images of a model are near in time.

    Args:
        model: The model.
        times_ns: As in `are_near`.
    """

    def __init__(self, model: pycolmap.Reconstruction, times_ns: Mapping[str, IntArray]) -> None:
        self._times_ns = times_ns
        self._refs = {
            int(number): ImageRef.parse(model.image(number).name) for number in model.reg_image_ids()
        }

    def __contains__(self, pair: tuple[int, int]) -> bool:
        """Return whether two images, by their ids, are of one camera and near in time."""
        one, other = (self._refs.get(number) for number in pair)
        return one is not None and other is not None and are_near(one, other, self._times_ns)
