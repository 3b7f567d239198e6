"""Select the pairs of keyframes to match: per keyframe, a number that does not grow with their total."""

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
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.retrieval import (
    LIKELY_RETRIEVAL_MATCHES,
    MIN_RETRIEVAL_MATCHES,
    RETRIEVAL_FEATURES,
    count_preemptive_matches,
    largest_descriptors,
)
from bodycap_batch.mapping.matching.skeletal_set import select_skeletal_keyframes

_NEIGHBOUR_STEPS = (1, 2, 3, 4, 6, 9, 14)
"""Distances, in keyframes of one camera, at which a keyframe is matched with its neighbours in time.
Evidence: none."""
_SIMULTANEOUS = 2
"""Keyframes of each other camera, nearest in time, that a keyframe is matched with. Evidence: none."""
_RETRIEVED = 64
"""Retrieved partners of a keyframe. Evidence: docs/decisions/mapping.md."""
_RETRIEVED_PER_CAMERA = 8
"""Retrieved partners of a keyframe in each camera, even if those in other cameras are more similar.
Evidence: none."""
_MIN_LINKS = 24
"""Links to another camera or another time that a keyframe needs. A keyframe with fewer is also matched with
the neighbours of its partners. Evidence: docs/decisions/mapping.md."""
_MIN_LINK_MATCHES = 20
"""Matches that a pair needs to count as a link. Evidence: docs/decisions/mapping.md."""
_NEAR_KEYFRAMES = 4
"""Keyframes of one camera up to this distance, in keyframes, show the same and are no links. A hand is back
within a second."""
_MAX_RETRY_PAIRS = 50_000
"""Pairs that are tried at most for a camera without any link: some minutes of computing."""
_EXHAUSTIVE_UP_TO = 120
"""Number of keyframes up to which every pair is matched. Evidence: none."""
_RESECTION_RETRIEVALS = 8
"""Most similar keyframes of the map that a keyframe is matched with before its resection.
Evidence: docs/decisions/mapping.md."""


class PairGenerator:
    """Generates pairs that hold a new keyframe; their number grows with that of the new keyframes only.

    Args:
        workspace: Folder of the database with extracted features.
        new: Keyframes that are not matched yet.
        common_ns: Common time of every frame, by camera, nanoseconds.
        options: The stage's options; ``pairs`` is "retrieval" or "exhaustive". Few keyframes are always
            matched exhaustively.
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
            ids = read_image_ids(database)
            self._images = sorted(ids)
            new_refs = set(new)
            self._new = [row for row, ref in enumerate(self._images) if ref in new_refs]
            self.exhaustive = options.pairs == "exhaustive" or len(self._images) <= _EXHAUSTIVE_UP_TO
            if not self.exhaustive:
                images = np.empty((len(self._images), RETRIEVAL_FEATURES, 128), np.float32)
                for row, ref in enumerate(self._images):
                    descriptors = np.asarray(database.read_descriptors(ids[ref]).data)
                    keypoints = np.asarray(database.read_keypoints(ids[ref]))
                    images[row] = largest_descriptors(descriptors, keypoints)
                cameras = [ref.camera for ref in self._images]
                counts = count_preemptive_matches(images, self._new, cameras, context)
                self._matches = dict(zip(self._new, counts, strict=True))
        self._times = np.array([common_ns[ref.camera][ref.frame] for ref in self._images], dtype=np.int64)
        self._index_images()

    def _index_images(self) -> None:
        """Prepare the look-up of rows by keyframe and by camera."""
        self._cameras = np.array([ref.camera for ref in self._images])
        self._row = {ref: row for row, ref in enumerate(self._images)}
        self._rows_of = {name: np.flatnonzero(self._cameras == name) for name in np.unique(self._cameras)}

    def reduced(self) -> PairGenerator:
        """Return a generator of the skeletal keyframes alone; `self` if every pair is matched."""
        if self.exhaustive:
            return self
        rows = select_skeletal_keyframes(np.array([self._matches[row] for row in self._new]), self._times)
        out = copy.copy(self)
        out.exhaustive = len(rows) <= _EXHAUSTIVE_UP_TO
        out._images = [self._images[row] for row in rows]
        out._new = list(range(len(rows)))
        out._matches = {new: self._matches[row][rows] for new, row in enumerate(rows)}
        out._times = self._times[rows]
        out._index_images()
        return out

    @property
    def refs(self) -> list[ImageRef]:
        """The keyframes among which pairs are generated."""
        return list(self._images)

    def resection_pairs(self, registered: Collection[ImageRef], missing: Collection[ImageRef]) -> list[Pair]:
        """Return the pairs that a resection needs: neighbours in time and similar keyframes of the map.

        Args:
            registered: Keyframes of the map.
            missing: Keyframes to be resected.
        """
        inside = np.zeros(len(self._images), dtype=bool)
        inside[[self._row[ref] for ref in registered]] = True
        pairs = set[tuple[int, int]]()
        for row in sorted(self._row[ref] for ref in missing):
            for rows in self._rows_of.values():
                candidates = rows[inside[rows]]
                time_apart = np.abs(self._times[candidates] - self._times[row])
                same_camera = self._cameras[rows[0]] == self._cameras[row]
                count = _NEAR_KEYFRAMES if same_camera else 1
                near = candidates[np.argsort(time_apart, kind="stable")[:count]]
                pairs |= {(row, int(other)) for other in near}
            likely = np.flatnonzero(inside & (self._matches[row] >= MIN_RETRIEVAL_MATCHES))
            best = likely[np.argsort(-self._matches[row][likely], kind="stable")[:_RESECTION_RETRIEVALS]]
            pairs |= {(row, int(other)) for other in best} | set(self._adjacent_pairs(row, row))
        return self._sorted(pairs)

    def initial_pairs(self) -> list[Pair]:
        """Return pairs of neighbours in time, of simultaneous keyframes, and of retrieved keyframes."""
        if self.exhaustive:
            return self._sorted({(row, other) for row in self._new for other in range(len(self._images))})
        return self._sorted({(row, other) for row in self._new for other in self._partners(row)})

    def expansion_pairs(self, verified: Mapping[Pair, int], tried: Collection[Pair]) -> list[Pair]:
        """Return the neighbours of verified pairs, for keyframes with few links.

        Two views of one place overlap over some time on both sides, so one verified pair leads to others.
        A block of keyframes with few links can be metres off in the map.

        Args:
            verified: Number of matches of every verified pair.
            tried: Pairs that were matched.
        """
        if self.exhaustive:
            return []
        links: Counter[int] = Counter()
        strong = [
            (self._row[a], self._row[b])
            for (a, b), count in sorted(verified.items())
            if count >= _MIN_LINK_MATCHES
        ]
        for a, b in strong:
            if self._is_link(a, b):
                links.update((a, b))
        new = set(self._new)
        expanded = {
            (min(pair), max(pair))
            for a, b in strong
            for pair in self._adjacent_pairs(a, b)
            if not new.isdisjoint(pair) and min(links[pair[0]], links[pair[1]]) < _MIN_LINKS
        }
        return [pair for pair in self._sorted(expanded) if pair not in tried]

    def unlinked_camera_pairs(self, verified: Mapping[Pair, int], tried: Collection[Pair]) -> list[Pair]:
        """Return all pairs of the cameras without links to other cameras; evenly spaced ones if too many.

        Args:
            verified: Number of matches of every verified pair.
            tried: Pairs that were matched.
        """
        linked = {ref.camera for a, b in verified if a.camera != b.camera for ref in (a, b)}
        unlinked = [row for row in self._new if self._images[row].camera not in linked]
        if self.exhaustive or len(set(self._cameras)) == 1:
            return []
        pairs = set[tuple[int, int]]()
        for camera in sorted({self._images[row].camera for row in unlinked}):
            own = [row for row in unlinked if self._images[row].camera == camera]
            others = np.flatnonzero(self._cameras != camera)
            step = math.ceil(math.sqrt(len(own) * len(others) / _MAX_RETRY_PAIRS))
            pairs |= set(product(own[::step], others[::step].tolist()))
        return [pair for pair in self._sorted(pairs) if pair not in tried]

    def _adjacent_pairs(self, a: int, b: int) -> Iterator[tuple[int, int]]:
        """Yield the pairs in which one of two rows is replaced by its neighbour in the same camera."""
        for x, y in ((a - 1, b), (a + 1, b), (a, b - 1), (a, b + 1)):
            inside = min(x, y) >= 0 and max(x, y) < len(self._images)
            if (
                inside
                and x != y
                and self._cameras[x] == self._cameras[a]
                and self._cameras[y] == self._cameras[b]
            ):
                yield x, y

    def _is_link(self, a: int, b: int) -> bool:
        """Return whether two rows are of different cameras or of different times."""
        return bool(self._cameras[a] != self._cameras[b]) or abs(a - b) > _NEAR_KEYFRAMES

    def _sorted(self, rows: Collection[tuple[int, int]]) -> list[Pair]:
        """Return pairs of rows as pairs of keyframes, each pair once, in a fixed order."""
        ordered = sorted({(min(pair), max(pair)) for pair in rows if pair[0] != pair[1]})
        return [(self._images[a], self._images[b]) for a, b in ordered]

    def _partners(self, row: int) -> set[int]:
        """Return the rows of the keyframes that one keyframe is matched with."""
        own = self._rows_of[self._cameras[row]]
        position = int(np.searchsorted(own, row))
        steps = [step * sign for step in _NEIGHBOUR_STEPS for sign in (-1, 1)]
        out = {int(own[position + step]) for step in steps if 0 <= position + step < len(own)}
        for camera, rows in self._rows_of.items():
            if camera == self._cameras[row]:
                continue
            time_apart = np.abs(self._times[rows] - self._times[row])
            out |= set(rows[np.argsort(time_apart, kind="stable")[:_SIMULTANEOUS]].tolist())
        return out | self._retrieved(row)

    def _retrieved(self, row: int) -> set[int]:
        """Return the most similar keyframes of each camera, and the most similar ones of all."""
        matches = self._matches[row]
        count = int((matches >= MIN_RETRIEVAL_MATCHES).sum())
        likely = np.argsort(-matches, kind="stable")[:count].tolist()
        order = [other for other in likely if self._is_link(row, other)]
        taken: Counter[str] = Counter()
        out: set[int] = set()
        for other in order:
            taken[self._cameras[other]] += 1
            if taken[self._cameras[other]] <= _RETRIEVED_PER_CAMERA:
                out.add(other)
        rest = (other for other in order if other not in out and matches[other] >= LIKELY_RETRIEVAL_MATCHES)
        return out | set(islice(rest, max(0, _RETRIEVED - len(out))))


def match_keyframes(
    generator: PairGenerator,
    workspace: Path,
    intrinsics: Mapping[str, CameraIntrinsics],
    context: StageContext,
) -> tuple[set[Pair], dict[str, object]]:
    """Match the initial pairs, then more pairs for keyframes and cameras with few links.

    Args:
        generator: Generates the pairs.
        workspace: Folder of the database.
        intrinsics: Intrinsics by camera name.
        context: Threads, progress, cancellation.

    Returns:
        The pairs that were matched, and entries for the log: pairs, verified pairs, links between cameras.
    """
    pairs = generator.initial_pairs()
    verified = match_pairs(workspace, pairs, intrinsics, context)
    tried = set(pairs)
    while more := (
        generator.expansion_pairs(verified, tried) or generator.unlinked_camera_pairs(verified, tried)
    ):
        verified |= match_pairs(workspace, more, intrinsics, context)
        tried |= set(more)
    context.progress(0, 0, "reconstruction")
    between = Counter(f"{a.camera} - {b.camera}" for a, b in verified if a.camera != b.camera)
    log = {
        "pairs": len(tried),
        "widened_pairs": len(tried) - len(pairs),
        "verified_pairs": len(verified),
        "linked_cameras": dict(sorted(between.items())),
    }
    return tried, log
