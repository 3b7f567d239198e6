"""Which keyframe pairs are matched: a number for each keyframe that does not grow with their number."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from itertools import islice, product
from pathlib import Path

import numpy as np

from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.retrieval import CHANCE, LARGEST, LIKELY, largest, likeness
from bodycap_batch.mapping.matching.skeletal_set import spanning_rows
from bodycap_batch.model.camera import Camera

_NEIGHBOURS = (1, 2, 3, 4, 6, 9, 14)
"""Steps along a camera's own keyframes."""
_SAME_INSTANT = 2
_LOOK_ALIKES = 64
"""Most alike partners of a keyframe: of what exhaustive matching verifies this leaves 99 % on room131 (with
30 % of the pairs) and 73 % on walk131 (with 34 %; there a keyframe sees what half of the others see)."""
_FEWEST_LOOK_ALIKES = 8
"""Of each camera, however alike the others are."""
_ENOUGH = 24
"""Links to another camera or another time that tie a keyframe well, and the matches each must have: one with
fewer is matched with the neighbours of what it was matched with. With 12 instead of 24 a keyframe of walk131
stood 15 cm off."""
_STRONG = 20
_BESIDE = 4
"""Keyframes of one camera nearer than this show the same; a hand is back within a second."""
_RETRIED = 50_000
"""Pairs that are tried at most of a camera without any link: some minutes; what holds beside them follows."""
_FEW = 120
"""Keyframes up to which every pair is matched."""
_PLACING = 8
"""Most alike keyframes of the map that one that is placed in it is matched with."""


class PairChooser:
    """Chooses pairs with at least one new keyframe; their number grows with that of the new keyframes only.

    Args:
        workspace: Folder of the database, features extracted.
        new: Keyframes not matched yet.
        common_ns: Common time of every frame, by camera.
        options: ``pairs``: "retrieval" or "exhaustive"; few keyframes are always matched exhaustively.
        context: Threads, progress, cancellation.
    """

    def __init__(
        self,
        workspace: Path,
        new: Collection[ImageRef],
        common_ns: Mapping[str, IntArray],
        options: MapOptions,
        context: StageContext,
    ) -> None:
        import pycolmap

        with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
            ids = image_ids(database)
            self._images = sorted(ids)
            wanted = set(new)
            self._new = [row for row, ref in enumerate(self._images) if ref in wanted]
            self.exhaustive = options.pairs == "exhaustive" or len(self._images) <= _FEW
            if not self.exhaustive:
                images = np.empty((len(self._images), LARGEST, 128), np.float32)
                for row, ref in enumerate(self._images):
                    found = np.asarray(database.read_descriptors(ids[ref]).data)
                    images[row] = largest(found, np.asarray(database.read_keypoints(ids[ref])))
                alike = likeness(images, self._new, [ref.camera for ref in self._images], context)
                self._alike = dict(zip(self._new, alike, strict=True))
        self._times = np.array([common_ns[ref.camera][ref.frame] for ref in self._images], dtype=np.int64)
        self._number()

    def _number(self) -> None:
        self._cameras = np.array([ref.camera for ref in self._images])
        self._row = {ref: row for row, ref in enumerate(self._images)}
        self._rows_of = {name: np.flatnonzero(self._cameras == name) for name in np.unique(self._cameras)}

    def spanning(self) -> PairChooser:
        """The same among keyframes that carry a map of all; of all of them where every pair is matched."""
        if self.exhaustive:
            return self
        rows = spanning_rows(np.array([self._alike[row] for row in self._new]), self._times)
        out = copy.copy(self)
        out.exhaustive = len(rows) <= _FEW
        out._images = [self._images[row] for row in rows]
        out._new = list(range(len(rows)))
        out._alike = {new: self._alike[row][rows] for new, row in enumerate(rows)}
        out._times = self._times[rows]
        out._number()
        return out

    @property
    def refs(self) -> list[ImageRef]:
        """The keyframes among which pairs are chosen."""
        return list(self._images)

    def placing(self, carrying: Collection[ImageRef], wanted: Collection[ImageRef]) -> list[Pair]:
        """Pairs that place keyframes in a map of others: neighbours in time and what looks most alike.

        Args:
            carrying: Keyframes of the map.
            wanted: Keyframes to be placed.
        """
        inside = np.zeros(len(self._images), dtype=bool)
        inside[[self._row[ref] for ref in carrying]] = True
        pairs = set[tuple[int, int]]()
        for row in sorted(self._row[ref] for ref in wanted):
            for rows in self._rows_of.values():
                mine = rows[inside[rows]]
                apart = np.abs(self._times[mine] - self._times[row])
                own = self._cameras[rows[0]] == self._cameras[row]
                near = mine[np.argsort(apart, kind="stable")[: _BESIDE if own else 1]]
                pairs |= {(row, int(other)) for other in near}
            likely = np.flatnonzero(inside & (self._alike[row] >= CHANCE))
            best = likely[np.argsort(-self._alike[row][likely], kind="stable")[:_PLACING]]
            pairs |= {(row, int(other)) for other in best} | set(self._beside(row, row))
        return self._sorted(pairs)

    def first(self) -> list[Pair]:
        """Neighbours in time, the same instant of other cameras, and what looks most alike."""
        if self.exhaustive:
            return self._sorted({(row, other) for row in self._new for other in range(len(self._images))})
        return self._sorted({(row, other) for row in self._new for other in self._partners(row)})

    def wider(self, held: Mapping[Pair, int], tried: Collection[Pair]) -> list[Pair]:
        """Neighbours of pairs that hold well, for keyframes that hang by few links.

        Two places that share a view do so over some time on both sides: from one pair that was found the
        others follow. A block that hangs by few links can stand metres off.

        Args:
            held: Matches of every pair that was verified.
            tried: Pairs that were matched.
        """
        if self.exhaustive:
            return []
        far: Counter[int] = Counter()
        strong = [(self._row[a], self._row[b]) for (a, b), count in sorted(held.items()) if count >= _STRONG]
        for a, b in strong:
            if self._is_far(a, b):
                far.update((a, b))
        new = set(self._new)
        beside = {
            (min(pair), max(pair))
            for a, b in strong
            for pair in self._beside(a, b)
            if not new.isdisjoint(pair) and min(far[pair[0]], far[pair[1]]) < _ENOUGH
        }
        return [pair for pair in self._sorted(beside) if pair not in tried]

    def unlinked(self, held: Mapping[Pair, int], tried: Collection[Pair]) -> list[Pair]:
        """Every pair of a camera that has no link to any other camera; of very many evenly spread ones."""
        tied = {ref.camera for a, b in held if a.camera != b.camera for ref in (a, b)}
        alone = [row for row in self._new if self._images[row].camera not in tied]
        if self.exhaustive or len(set(self._cameras)) == 1:
            return []
        every = set[tuple[int, int]]()
        for camera in sorted({self._images[row].camera for row in alone}):
            mine = [row for row in alone if self._images[row].camera == camera]
            others = np.flatnonzero(self._cameras != camera)
            step = math.ceil(math.sqrt(len(mine) * len(others) / _RETRIED))
            every |= set(product(mine[::step], others[::step].tolist()))
        return [pair for pair in self._sorted(every) if pair not in tried]

    def _beside(self, a: int, b: int) -> Iterator[tuple[int, int]]:
        for x, y in ((a - 1, b), (a + 1, b), (a, b - 1), (a, b + 1)):
            inside = min(x, y) >= 0 and max(x, y) < len(self._images)
            if (
                inside
                and x != y
                and self._cameras[x] == self._cameras[a]
                and self._cameras[y] == self._cameras[b]
            ):
                yield x, y

    def _is_far(self, a: int, b: int) -> bool:
        return bool(self._cameras[a] != self._cameras[b]) or abs(a - b) > _BESIDE

    def _sorted(self, rows: Collection[tuple[int, int]]) -> list[Pair]:
        ordered = sorted({(min(pair), max(pair)) for pair in rows if pair[0] != pair[1]})
        return [(self._images[a], self._images[b]) for a, b in ordered]

    def _partners(self, row: int) -> set[int]:
        """Rows of the keyframes that one keyframe is matched with."""
        own = self._rows_of[self._cameras[row]]
        place = int(np.searchsorted(own, row))
        steps = [step * sign for step in _NEIGHBOURS for sign in (-1, 1)]
        out = {int(own[place + step]) for step in steps if 0 <= place + step < len(own)}
        for camera, rows in self._rows_of.items():
            if camera == self._cameras[row]:
                continue
            apart = np.abs(self._times[rows] - self._times[row])
            out |= set(rows[np.argsort(apart, kind="stable")[:_SAME_INSTANT]].tolist())
        return out | self._look_alikes(row)

    def _look_alikes(self, row: int) -> set[int]:
        """The most alike of each camera, and the most alike of all."""
        alike = self._alike[row]
        likely = np.argsort(-alike, kind="stable")[: int((alike >= CHANCE).sum())].tolist()
        order = [other for other in likely if self._is_far(row, other)]
        taken: Counter[str] = Counter()
        out: set[int] = set()
        for other in order:
            taken[self._cameras[other]] += 1
            if taken[self._cameras[other]] <= _FEWEST_LOOK_ALIKES:
                out.add(other)
        rest = (other for other in order if other not in out and alike[other] >= LIKELY)
        return out | set(islice(rest, max(0, _LOOK_ALIKES - len(out))))


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
    while fresh := chooser.wider(held, tried) or chooser.unlinked(held, tried):
        held |= match_pairs(workspace, fresh, lenses, context)
        tried |= set(fresh)
    context.progress(0, 0, "reconstruction")
    between = Counter(f"{a.camera} - {b.camera}" for a, b in held if a.camera != b.camera)
    log = {
        "pairs": len(tried),
        "widened_pairs": len(tried) - len(pairs),
        "verified_pairs": len(held),
        "linked_cameras": dict(sorted(between.items())),
    }
    return tried, log
