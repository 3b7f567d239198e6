"""Find misplaced blocks: keyframes whose verified matches do not belong to common points of the map.

The epipolar geometry of two poses does not depend on the distance between the cameras. Therefore it does not
show a block of keyframes that is too large or too small, or that was moved along the rays. The points show
it: if a block has another scale or place than the rest, a feature of the block and its match in the rest do
not fit one point. Mapping then keeps two points, or removes one of the two observations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef
from bodycap_batch.mapping.matching.near_pairs import NO_TIMES, NearPairs
from bodycap_batch.mapping.validation.second_registration import observed_points

if TYPE_CHECKING:
    import pycolmap

_MIN_AGREEMENT = 0.8
"""Minimum agreement of a block of keyframes: the fraction of its matches with all other keyframes that belong
to common points. A block with a smaller fraction is misplaced. Evidence: docs/decisions/mapping.md."""
_MAX_BLOCK = 100
"""Maximum number of keyframes of a tested block. The time of the test is proportional to this number.
Evidence: none."""
_MIN_PAIR_AGREEMENT = 0.5
"""Minimum fraction of the matches of a pair that must belong to common points, so that the pair connects its
two keyframes. Evidence: none."""
_MIN_SUPPORT = 30
"""Minimum number of matches at common points that connect a keyframe with the main part of the map, over all
pairs. COLMAP's minimum number of points for the registration of an image. Evidence:
docs/decisions/mapping.md."""


@dataclass(frozen=True, slots=True)
class PairAgreement:
    """The matches of a verified pair of registered images, compared with the points of a map.

    Attributes:
        first: Id of the pair's first image.
        second: Id of the pair's second image.
        judged: Number of matches of which at least one feature observes a point.
        agreeing: Number of matches whose two features observe the same point.
    """

    first: int
    second: int
    judged: int
    agreeing: int

    @property
    def connects(self) -> bool:
        """Whether enough matches belong to common points to connect the two images."""
        return self.agreeing >= max(1.0, _MIN_PAIR_AGREEMENT * self.judged)


def evaluate_agreement(
    workspace: Path, model: pycolmap.Reconstruction, times_ns: Mapping[str, IntArray] = NO_TIMES
) -> list[PairAgreement]:
    """Compare the matches of all verified pairs of registered images with the points of a model.

    Of a pair that is near in time (`near_pairs`), only the matches that agree are judged.

    Args:
        workspace: Folder of the database.
        model: The model.
        times_ns: Times (N,) of all frames of each camera, nanoseconds, by camera name.
    """
    import pycolmap

    points = {int(number): observed_points(model, int(number)) for number in model.reg_image_ids()}
    near = NearPairs(model, times_ns)
    out = []
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            first, second = map(int, pycolmap.pair_id_to_image_pair(pair))
            if first in points and second in points:
                matches = np.asarray(geometry.inlier_matches)
                a, b = points[first][matches[:, 0]], points[second][matches[:, 1]]
                agreeing = int(((a == b) & (a >= 0)).sum())
                judged = agreeing if (first, second) in near else int(((a >= 0) | (b >= 0)).sum())
                out.append(PairAgreement(first, second, judged, agreeing))
    return out


def image_sequences(model: pycolmap.Reconstruction) -> list[list[int]]:
    """Return the ids of each camera's registered images, in the order of time."""
    refs = sorted((ImageRef.parse(model.image(number).name), int(number)) for number in model.reg_image_ids())
    cameras: dict[str, list[int]] = {}
    for ref, number in refs:
        cameras.setdefault(ref.camera, []).append(number)
    return list(cameras.values())


def find_misplaced_images(pairs: Sequence[PairAgreement], sequences: Sequence[Sequence[int]]) -> set[int]:
    """Return the ids of misplaced images.

    Two kinds of images are misplaced. First, blocks of successive images of one camera. The agreement of a
    block is the fraction of its matches with all images outside the block that belong to common points. In
    each step the block with the smallest agreement is removed, until every block has an agreement of at least
    `_MIN_AGREEMENT`. A block that drifts away agrees at one end and contradicts the other images, so only its
    agreement as a whole shows it. Second, images that too few common points connect with the largest
    remaining part: the rest of a block that agrees only with itself.

    Images that contradict only misplaced images are correct. Therefore removed blocks that agree with the
    largest remaining part are added to it again.

    Args:
        pairs: The verified pairs of registered images.
        sequences: For each camera, the ids of its registered images in the order of time.
    """
    partners: dict[int, dict[int, PairAgreement]] = {}
    for pair in pairs:
        if pair.judged:
            partners.setdefault(pair.first, {})[pair.second] = pair
            partners.setdefault(pair.second, {})[pair.first] = pair
    removed = _remove_blocks(partners, sequences)
    images = {image for sequence in sequences for image in sequence}
    kept = _largest_connected(partners, set(partners) - {image for block in removed for image in block})
    left = list(reversed(removed))
    while True:
        block = next((block for block in left if _agrees(block, kept, partners)), None)
        if block is None:
            return images - kept
        kept |= set(block)
        left.remove(block)


def _remove_blocks(
    partners: Mapping[int, Mapping[int, PairAgreement]], sequences: Sequence[Sequence[int]]
) -> list[tuple[int, ...]]:
    """Return the blocks that contradict the other images, in the order of their removal."""
    ids, pairs = _pair_table(partners)
    removed = list[tuple[int, ...]]()
    while True:
        degree = np.bincount(pairs[0], minlength=len(ids))
        with_pairs = {image for image, count in zip(ids.tolist(), degree.tolist(), strict=True) if count}
        left = ([image for image in sequence if image in with_pairs] for sequence in sequences)
        worst = min((_worst_block(sequence, ids, pairs) for sequence in left), default=_NO_BLOCK)
        if worst.agreement >= _MIN_AGREEMENT:
            return removed
        removed.append(worst.images)
        pairs = pairs[:, ~np.isin(ids, worst.images)[pairs[:2]].any(axis=0)]


def _pair_table(partners: Mapping[int, Mapping[int, PairAgreement]]) -> tuple[IntArray, IntArray]:
    """Return pairs as arrays.

    Args:
        partners: By image, the pairs of the image, by the other image.

    Returns:
        (N,) ids of the images, increasing; (4,P) pairs, each in both directions: row of the first and of the
            second image in these ids, number of judged matches, number of agreeing matches.
    """
    ids = np.array(sorted(partners), dtype=np.int64)
    pairs = [
        (image, other, pair.judged, pair.agreeing)
        for image, others in partners.items()
        for other, pair in others.items()
    ]
    table = np.array(pairs, dtype=np.int64).reshape(-1, 4).T
    table[:2] = np.searchsorted(ids, table[:2])
    return ids, table


def _agrees(
    block: Sequence[int], images: Collection[int], partners: Mapping[int, Mapping[int, PairAgreement]]
) -> bool:
    """Return whether enough matches of a block with other images belong to common points."""
    pairs = [pair for image in block for other, pair in partners[image].items() if other in images]
    agreeing = sum(pair.agreeing for pair in pairs)
    return agreeing >= max(_MIN_SUPPORT, _MIN_AGREEMENT * sum(pair.judged for pair in pairs))


class _Block(NamedTuple):
    """A block of successive images of one camera.

    Attributes:
        agreement: Fraction of the block's matches with images outside the block that belong to common points.
        size: Number of images. Of two blocks with the same agreement, the smaller one is misplaced.
        images: Ids of the images.
    """

    agreement: float
    size: int
    images: tuple[int, ...]


_NO_BLOCK = _Block(1.0, 0, ())
"""Result of a test that found no misplaced block. The agreement of 1 is the largest possible fraction."""


def _worst_block(sequence: Sequence[int], ids: IntArray, pairs: IntArray) -> _Block:
    """Return the block of successive images with the smallest agreement.

    Blocks with fewer than `_MIN_SUPPORT` judged matches with images outside the block are not tested.

    Args:
        sequence: Ids of one camera's images in the order of time.
        ids: (N,) ids of all images, from `_pair_table`.
        pairs: (4,P) pairs of the remaining images, from `_pair_table`.
    """
    count = len(sequence)
    longest = min(count, _MAX_BLOCK)
    position = np.full(len(ids), -1)
    position[np.searchsorted(ids, np.array(sequence, dtype=np.int64))] = np.arange(count)
    own = pairs[:, position[pairs[0]] >= 0]
    index, other = position[own[:2]]
    lag = np.where(other >= 0, index - other, 0)
    is_near = (lag > 0) & (lag < longest)
    # Rows: judged matches, agreeing matches. `near` holds the matches between images up to `longest` apart.
    total = np.zeros((2, count))
    near = np.zeros((2, longest, count))
    for row, counts in enumerate(own[2:]):
        np.add.at(total[row], index, counts)
        np.add.at(near[row], (lag[is_near], index[is_near]), counts[is_near])
    sums = np.concatenate([np.zeros((2, 1)), total.cumsum(axis=1)], axis=1)
    inside, ending, worst = np.zeros((2, count)), np.zeros((2, count)), _NO_BLOCK
    for length in range(1, longest + 1):
        # Matches of each image with the `length` - 1 images before it.
        ending += near[:, length - 1]
        starts = count - length + 1
        inside = inside[:, :starts] + ending[:, length - 1 :]
        judged, agreeing = sums[:, length:] - sums[:, :starts] - 2.0 * inside
        agreement = np.where(judged >= _MIN_SUPPORT, agreeing / np.maximum(judged, 1.0), 1.0)
        start = int(np.argmin(agreement))
        if agreement[start] < worst.agreement:
            worst = _Block(float(agreement[start]), length, tuple(sequence[start : start + length]))
    return worst


def _largest_connected(partners: Mapping[int, Mapping[int, PairAgreement]], remaining: set[int]) -> set[int]:
    """Return the largest part of the remaining images that enough common points connect.

    A part grows from the image with the most common points and its nearest partners. In each step, the images
    that enough common points connect with the part are added.
    """
    links = {
        image: {
            other: pair.agreeing
            for other, pair in partners[image].items()
            if pair.connects and other in remaining
        }
        for image in remaining
    }
    best: set[int] = set()
    while remaining:
        seed = max(remaining, key=lambda image: (sum(links[image].values()), -image))
        part, support = set[int](), dict[int, int]()
        strongest = max(links[seed].values(), default=0)
        added = {seed} | {other for other, count in links[seed].items() if 2 * count >= strongest}
        while added:
            part |= added
            for image in added:
                for other, count in links[image].items():
                    support[other] = support.get(other, 0) + count
            added = {image for image, count in support.items() if image not in part and count >= _MIN_SUPPORT}
        best = max(best, part, key=len)
        remaining = remaining - part
    return best
