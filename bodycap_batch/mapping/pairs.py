"""Which keyframe pairs are matched."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from bodycap_batch.arrays import FloatArray, IntArray
from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.database import DATABASE_NAME, ImageRef, Pair, image_ids
from bodycap_batch.mapping.retrieval import similarity

_NEIGHBOURS = (1, 2, 3, 4, 6, 9, 14)
"""Steps along a camera's own keyframes."""
_RANKS = (0, 1, 2, 4, 8, 16, 32, 64)
"""Places in the order of likeness at which partners are taken, from the same camera at another time and from
each other camera. The most alike repeat each other: a wide choice ties a map better than the top 8."""
_SAME_INSTANT = 2
_AWAY_NS = 2_000_000_000
"""A keyframe's nearest looks are its own neighbours in time: they are matched anyway."""


def choose_pairs(
    workspace: Path,
    new: Collection[ImageRef],
    common_ns: Mapping[str, IntArray],
    options: MapOptions,
) -> list[Pair]:
    """Pairs with at least one new keyframe: neighbours, the same instant, and what looks alike.

    Args:
        workspace: Folder of the database, features extracted.
        new: Keyframes not matched yet.
        common_ns: Common time of every frame, by camera.
        options: ``pairs``: "retrieval" or "exhaustive"; few keyframes are always matched exhaustively.

    Returns:
        Pairs in a fixed order; their number grows with that of the new keyframes only.
    """
    import pycolmap

    fresh = set(new)
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = image_ids(database)
        images = sorted(ids)
        every = [(a, b) for a, b in combinations(images, 2) if a in fresh or b in fresh]
        quota = 2 * len(_NEIGHBOURS) + len(_RANKS) + (len(_RANKS) + _SAME_INSTANT) * (len(common_ns) - 1)
        if options.pairs == "exhaustive" or len(every) <= quota * len(fresh):
            return every
        descriptors = [np.asarray(database.read_descriptors(ids[ref]).data) for ref in images]
    alike = similarity(descriptors, options.seed)
    times = np.array([common_ns[ref.camera][ref.frame] for ref in images])
    cameras = np.array([ref.camera for ref in images])
    chosen: set[tuple[int, int]] = set()
    for row, ref in enumerate(images):
        if ref in fresh:
            partners = _partners(row, alike[row], times, cameras)
            chosen |= {(min(row, other), max(row, other)) for other in partners}
    return [(images[a], images[b]) for a, b in sorted(chosen)]


def _partners(row: int, alike: FloatArray, times: IntArray, cameras: np.ndarray) -> set[int]:
    """Rows of the keyframes that one keyframe is matched with."""
    own = np.flatnonzero(cameras == cameras[row])
    place = int(np.searchsorted(own, row))
    out = {
        int(own[place + step])
        for offset in _NEIGHBOURS
        for step in (-offset, offset)
        if 0 <= place + step < len(own)
    }
    away = own[np.abs(times[own] - times[row]) > _AWAY_NS]
    out |= _alike(alike, away)
    for camera in np.unique(cameras):
        if camera == cameras[row]:
            continue
        other = np.flatnonzero(cameras == camera)
        closest = other[np.argsort(np.abs(times[other] - times[row]), kind="stable")[:_SAME_INSTANT]]
        out |= {int(item) for item in closest} | _alike(alike, other)
    return out


def _alike(alike: FloatArray, rows: IntArray) -> set[int]:
    order = rows[np.argsort(-alike[rows], kind="stable")]
    return {int(order[rank]) for rank in _RANKS if rank < len(order)}
