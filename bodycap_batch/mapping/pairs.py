"""Which keyframe pairs are matched."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np

from bodycap_batch.arrays import IntArray
from bodycap_batch.camera import Camera
from bodycap_batch.config import MapOptions
from bodycap_batch.context import StageContext
from bodycap_batch.mapping.database import DATABASE_NAME, ImageRef, Pair, image_ids
from bodycap_batch.mapping.matching import match_pairs
from bodycap_batch.mapping.retrieval import similarity

_NEIGHBOURS = (1, 2, 3, 4, 6, 9, 14)
"""Steps along a camera's own keyframes."""
_RANKS = (0, 1, 2, 4, 8, 16, 32, 64)
"""Places in the order of likeness at which partners are taken, from the same camera at another time and from
each other camera. The most alike repeat each other: a wide choice ties a map better than the top 8."""
_ENOUGH = 12
"""Links to another camera or another time that tie a keyframe well, and the matches each must have."""
_STRONG = 20
_WIDE = 64
_SAME_INSTANT = 2
_AWAY_NS = 2_000_000_000
"""A keyframe's nearest looks are its own neighbours in time: they are matched anyway."""


class PairChooser:
    """Chooses pairs with at least one new keyframe; their number grows with that of the new keyframes only.

    Args:
        workspace: Folder of the database, features extracted.
        new: Keyframes not matched yet.
        common_ns: Common time of every frame, by camera.
        options: ``pairs``: "retrieval" or "exhaustive"; few keyframes are always matched exhaustively.
    """

    def __init__(
        self,
        workspace: Path,
        new: Collection[ImageRef],
        common_ns: Mapping[str, IntArray],
        options: MapOptions,
    ) -> None:
        import pycolmap

        with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
            ids = image_ids(database)
            self._images = sorted(ids)
            self._new = [row for row, ref in enumerate(self._images) if ref in set(new)]
            cameras = len(common_ns)
            quota = 2 * len(_NEIGHBOURS) + len(_RANKS) + (len(_RANKS) + _SAME_INSTANT) * (cameras - 1)
            few = self._count_all() <= quota * len(self._new)
            self.exhaustive = options.pairs == "exhaustive" or few
            if not self.exhaustive:
                read = (np.asarray(database.read_descriptors(ids[ref]).data) for ref in self._images)
                self._alike = similarity(list(read), options.seed)
        self._times = np.array([common_ns[ref.camera][ref.frame] for ref in self._images], dtype=np.int64)
        self._cameras = np.array([ref.camera for ref in self._images])

    def first(self) -> list[Pair]:
        """Neighbours in time, the same instant of other cameras, and what looks alike near and far."""
        if self.exhaustive:
            return self._sorted({(row, other) for row in self._new for other in range(len(self._images))})
        return self._sorted({(row, other) for row in self._new for other in self._partners(row)})

    def wider(self, held: Mapping[Pair, int]) -> list[Pair]:
        """More partners for keyframes that hang by few links: a block that does can stand metres off.

        Args:
            held: Matches of every pair that was verified.
        """
        far = dict.fromkeys(self._images, 0)
        for pair, count in held.items():
            if count >= _STRONG and self._is_far(*pair):
                for ref in pair:
                    far[ref] = far.get(ref, 0) + 1
        weak = [row for row in self._new if far[self._images[row]] < _ENOUGH]
        if self.exhaustive:
            return []
        return self._sorted({(row, other) for row in weak for other in self._looks_like(row, range(_WIDE))})

    def unlinked(self, held: Mapping[Pair, int]) -> list[Pair]:
        """Every pair of a camera that has no link to any other camera."""
        tied = {ref.camera for a, b in held if a.camera != b.camera for ref in (a, b)}
        alone = [row for row in self._new if self._images[row].camera not in tied]
        if self.exhaustive or len(set(self._cameras)) == 1:
            return []
        return self._sorted(
            {
                (row, int(other))
                for row in alone
                for other in np.flatnonzero(self._cameras != self._cameras[row])
            }
        )

    def _is_far(self, a: ImageRef, b: ImageRef) -> bool:
        rows = [bisect_left(self._images, ref) for ref in (a, b)]
        return a.camera != b.camera or abs(int(np.diff(self._times[rows])[0])) > _AWAY_NS

    def _count_all(self) -> int:
        new, old = len(self._new), len(self._images) - len(self._new)
        return new * (new - 1) // 2 + new * old

    def _sorted(self, rows: Collection[tuple[int, int]]) -> list[Pair]:
        ordered = sorted({(min(pair), max(pair)) for pair in rows if pair[0] != pair[1]})
        return [(self._images[a], self._images[b]) for a, b in ordered]

    def _partners(self, row: int) -> set[int]:
        """Rows of the keyframes that one keyframe is matched with."""
        own = np.flatnonzero(self._cameras == self._cameras[row])
        place = int(np.searchsorted(own, row))
        steps = [step * sign for step in _NEIGHBOURS for sign in (-1, 1)]
        out = {int(own[place + step]) for step in steps if 0 <= place + step < len(own)}
        for camera in np.unique(self._cameras[self._cameras != self._cameras[row]]):
            other = np.flatnonzero(self._cameras == camera)
            apart = np.abs(self._times[other] - self._times[row])
            out |= {int(item) for item in other[np.argsort(apart, kind="stable")[:_SAME_INSTANT]]}
        return out | self._looks_like(row, _RANKS)

    def _looks_like(self, row: int, ranks: Iterable[int]) -> set[int]:
        """Partners at these places in likeness: of its own camera at another time, of each other."""
        out = set()
        for camera in np.unique(self._cameras):
            rows = np.flatnonzero(self._cameras == camera)
            if camera == self._cameras[row]:
                rows = rows[np.abs(self._times[rows] - self._times[row]) > _AWAY_NS]
            order = rows[np.argsort(-self._alike[row][rows], kind="stable")]
            out |= {int(order[rank]) for rank in ranks if rank < len(order)}
        return out


def link_keyframes(
    chooser: PairChooser,
    workspace: Path,
    lenses: Mapping[str, tuple[Camera, bool]],
    context: StageContext,
) -> tuple[set[Pair], dict[str, object]]:
    """Match the chosen pairs, then more for what hangs by few links or by none.

    Returns:
        The pairs tried, and an account for the log: pairs, verified pairs, links between cameras.
    """
    pairs = chooser.first()
    held = match_pairs(workspace, pairs, lenses, context)
    tried = set(pairs)
    widened = 0
    for more in (chooser.wider, chooser.unlinked):
        fresh = [pair for pair in more(held) if pair not in tried]
        widened += len(fresh)
        held |= match_pairs(workspace, fresh, lenses, context)
        tried |= set(fresh)
    between = Counter(f"{a.camera} - {b.camera}" for a, b in held if a.camera != b.camera)
    log = {
        "pairs": len(tried),
        "widened_pairs": widened,
        "verified_pairs": len(held),
        "linked_cameras": dict(sorted(between.items())),
    }
    return tried, log
