"""Select the pairs of keyframes to match.

With retrieval, the number of pairs for each keyframe does not depend on the total number of keyframes.
"""

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
from bodycap_batch.core.progress import RECONSTRUCTION
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
"""Steps from a keyframe to other keyframes of the same camera, counted in keyframes. A keyframe is matched
with the keyframes at these steps before it and after it. Evidence: none."""
_SIMULTANEOUS = 2
"""Number of simultaneous partners. A keyframe is matched with this number of keyframes of each other camera:
the keyframes that are nearest in time. Evidence: none."""
_RETRIEVED = 64
"""Maximum number of retrieved partners of a keyframe. A retrieved partner is a similar keyframe with which
the keyframe is matched. The maximum does not apply to the partners that are taken first from each camera
(`_RETRIEVED_PER_CAMERA`). Evidence: docs/decisions/mapping.md."""
_RETRIEVED_PER_CAMERA = 8
"""Maximum number of retrieved partners of a keyframe that are taken first from each camera. After these, the
most similar keyframes of all cameras are taken. Evidence: none."""
_MIN_LINKS = 24
"""Minimum number of links of a keyframe. A link is a verified pair with a keyframe of another camera or of a
distant time. A keyframe with fewer links is also matched with the neighbours of its partners.
Evidence: docs/decisions/mapping.md."""
_MIN_LINK_MATCHES = 20
"""Minimum number of verified matches of a link. A pair with fewer matches is not a link.
Evidence: docs/decisions/mapping.md."""
_NEAR_KEYFRAMES = 4
"""Maximum number of steps, from keyframe to keyframe, between two keyframes of one camera that are near in
time. Such keyframes show the same part of the room, so their pair is not a link. The number is small because
a hand can come back to a place within a second."""
_MAX_RETRY_PAIRS = 50_000
"""Approximate maximum number of pairs that are matched for a camera without a verified pair with another
camera. Matching this number of pairs takes some minutes."""
_EXHAUSTIVE_UP_TO = 120
"""Maximum number of keyframes of a capture in which every pair of keyframes is matched. Evidence: none."""
_RESECTION_RETRIEVALS = 8
"""Maximum number of retrieved partners for a resection. Before a keyframe is resected, the keyframe is
matched with its most similar keyframes in the map, at most this number.
Evidence: docs/decisions/mapping.md."""


class PairGenerator:
    """Generates the pairs of keyframes to match. Every pair contains at least one new keyframe.

    With retrieval, the number of pairs is proportional to the number of new keyframes.

    Args:
        workspace: Folder of the database with extracted features.
        new: Keyframes that are not matched yet.
        common_ns: Common time (nanoseconds) of every frame, by camera name.
        options: The stage's options. ``pairs`` is "retrieval" or "exhaustive". With at most
            `_EXHAUSTIVE_UP_TO` keyframes, every pair is matched in both modes.
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
        """Prepare the look-up of row numbers by keyframe and by camera name."""
        self._cameras = np.array([ref.camera for ref in self._images])
        # Comparisons of numbers in a list are several times as fast as those of names in an array.
        self._camera_numbers = np.unique(self._cameras, return_inverse=True)[1].tolist()
        self._row = {ref: row for row, ref in enumerate(self._images)}
        self._rows_of = {name: np.flatnonzero(self._cameras == name) for name in np.unique(self._cameras)}

    def reduced(self) -> PairGenerator:
        """Return a generator for only the skeletal keyframes; return `self` if every pair is matched.

        Skeletal keyframes are the reduced set of keyframes, Snavely's skeletal set.
        """
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
        """All keyframes from which the generator makes pairs."""
        return list(self._images)

    def resection_pairs(self, registered: Collection[ImageRef], missing: Collection[ImageRef]) -> list[Pair]:
        """Return the pairs that the resection of keyframes needs.

        Each missing keyframe is paired with three kinds of keyframes: the keyframes of the map that are
        nearest in time, the most similar keyframes of the map, and its two neighbours in the same camera.

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
        """Return the pairs that are matched first.

        Each new keyframe is paired with its neighbours in time, with the simultaneous keyframes of other
        cameras, and with similar keyframes. In exhaustive mode, each new keyframe is paired with all
        keyframes.
        """
        if self.exhaustive:
            return self._sorted({(row, other) for row in self._new for other in range(len(self._images))})
        return self._sorted({(row, other) for row in self._new for other in self._partners(row)})

    def expansion_pairs(self, verified: Mapping[Pair, int], tried: Collection[Pair]) -> list[Pair]:
        """Return untried pairs near verified pairs, for keyframes with fewer than `_MIN_LINKS` links.

        In a returned pair, one keyframe of a verified pair is replaced by its neighbour in time. Such a pair
        often has matches: if two cameras see a common place, they usually also see a common place shortly
        before and after. Links are important: without enough links, a block of keyframes can be metres away
        from its correct position in the map.

        Args:
            verified: Number of matches of every verified pair.
            tried: Pairs that were already matched.
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
        """Return untried pairs for cameras without any verified pair with another camera.

        Every new keyframe of such a camera is paired with every keyframe of all other cameras. If this gives
        more than `_MAX_RETRY_PAIRS` pairs, only evenly spaced keyframes are paired.

        Args:
            verified: Number of matches of every verified pair.
            tried: Pairs that were already matched.
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
        """Yield the pairs in which row `a` or row `b` is replaced by its neighbour in the same camera."""
        camera, count = self._camera_numbers, len(self._images)
        for x, y in ((a - 1, b), (a + 1, b), (a, b - 1), (a, b + 1)):
            inside = 0 <= x < count and 0 <= y < count
            if inside and x != y and camera[x] == camera[a] and camera[y] == camera[b]:
                yield x, y

    def _is_link(self, a: int, b: int) -> bool:
        """Return whether a pair of rows can be a link: different cameras, or distant rows of one camera."""
        return self._camera_numbers[a] != self._camera_numbers[b] or abs(a - b) > _NEAR_KEYFRAMES

    def _sorted(self, rows: Collection[tuple[int, int]]) -> list[Pair]:
        """Convert pairs of rows to pairs of keyframes. Each pair occurs once, and the order is fixed."""
        ordered = sorted({(min(pair), max(pair)) for pair in rows if pair[0] != pair[1]})
        return [(self._images[a], self._images[b]) for a, b in ordered]

    def _partners(self, row: int) -> set[int]:
        """Return the rows of the keyframes with which `initial_pairs` pairs the keyframe in row `row`."""
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
        """Return the rows of the retrieved partners of the keyframe `row`.

        The most similar keyframes of each camera are taken first, then the most similar keyframes of all
        cameras.
        """
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
    """Match the initial pairs, then further pairs for keyframes with few links and cameras without links.

    Args:
        generator: Generates the pairs.
        workspace: Folder of the database.
        intrinsics: Intrinsics by camera name.
        context: Threads, progress, cancellation.

    Returns:
        All pairs that were matched; entries for the log: numbers of pairs and verified pairs, and the number
        of verified pairs between each two cameras.
    """
    pairs = generator.initial_pairs()
    verified = match_pairs(workspace, pairs, intrinsics, context)
    tried = set(pairs)
    while more := (
        generator.expansion_pairs(verified, tried) or generator.unlinked_camera_pairs(verified, tried)
    ):
        verified |= match_pairs(workspace, more, intrinsics, context)
        tried |= set(more)
    context.progress(0, 0, RECONSTRUCTION)
    between = Counter(f"{a.camera} - {b.camera}" for a, b in verified if a.camera != b.camera)
    log = {
        "pairs": len(tried),
        "widened_pairs": len(tried) - len(pairs),
        "verified_pairs": len(verified),
        "linked_cameras": dict(sorted(between.items())),
    }
    return tried, log
