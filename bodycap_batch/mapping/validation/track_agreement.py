"""Find misplaced blocks: keyframes whose verified matches do not belong to common points of the map.

The epipolar geometry of two poses does not depend on the distance between the cameras. Therefore it does not
show a block of keyframes that is too large or too small, or that was moved along the rays. The points show
it: if a block has another scale or place than the rest, a feature of the block and its match in the rest do
not fit one point. Mapping then keeps two points, or removes one of the two observations.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.mapping.matching.database import DATABASE_NAME

if TYPE_CHECKING:
    import pycolmap

_MIN_AGREEMENT = 0.8
"""Minimum agreement of a keyframe: the fraction of its matches that belong to common points. A keyframe with
a smaller fraction is misplaced. Evidence: docs/decisions/mapping.md."""
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


def evaluate_agreement(workspace: Path, model: pycolmap.Reconstruction) -> list[PairAgreement]:
    """Compare the matches of all verified pairs of registered images with the points of a model."""
    import pycolmap

    points = {int(number): _observed_points(model, number) for number in model.reg_image_ids()}
    out = []
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            first, second = map(int, pycolmap.pair_id_to_image_pair(pair))
            if first in points and second in points:
                matches = np.asarray(geometry.inlier_matches)
                a, b = points[first][matches[:, 0]], points[second][matches[:, 1]]
                judged = int(((a >= 0) | (b >= 0)).sum())
                out.append(PairAgreement(first, second, judged, int(((a == b) & (a >= 0)).sum())))
    return out


def _observed_points(model: pycolmap.Reconstruction, image_id: int) -> IntArray:
    """Return the id (N,) of the point that each feature of an image observes; −1 without a point."""
    image = model.image(image_id)
    out = np.full(image.num_points2D(), -1, dtype=np.int64)
    for feature in image.get_observation_point2D_idxs():
        out[feature] = image.point2D(feature).point3D_id
    return out


def find_misplaced_images(pairs: Sequence[PairAgreement], images: Collection[int]) -> set[int]:
    """Return the ids of misplaced images.

    Two kinds of images are misplaced. First, in each step the image with the smallest agreement is removed,
    with its pairs, until every remaining image has an agreement of at least `_MIN_AGREEMENT`. The removal of
    a misplaced image lowers the agreement of the other images of its block, and raises the agreement of the
    correct images around it. Second, images that too few common points connect with the largest remaining
    part: the rest of a block that agrees only with itself.

    Args:
        pairs: The verified pairs of registered images.
        images: Ids of all registered images.
    """
    partners: dict[int, dict[int, PairAgreement]] = {}
    for pair in pairs:
        if pair.judged:
            partners.setdefault(pair.first, {})[pair.second] = pair
            partners.setdefault(pair.second, {})[pair.first] = pair
    remaining = _without_disagreeing(partners)
    return set(images) - _largest_connected(partners, remaining)


def _without_disagreeing(partners: dict[int, dict[int, PairAgreement]]) -> set[int]:
    """Return the images that remain after images with a small agreement were removed one after the other."""
    judged = {image: sum(pair.judged for pair in of.values()) for image, of in partners.items()}
    agreeing = {image: sum(pair.agreeing for pair in of.values()) for image, of in partners.items()}
    remaining = set(partners)

    def agreement(image: int) -> tuple[float, int]:
        return agreeing[image] / judged[image] if judged[image] else 0.0, image

    while remaining:
        worst = min(remaining, key=agreement)
        if agreement(worst)[0] >= _MIN_AGREEMENT:
            break
        remaining.remove(worst)
        for other, pair in partners[worst].items():
            judged[other] -= pair.judged
            agreeing[other] -= pair.agreeing
    return remaining


def _largest_connected(partners: dict[int, dict[int, PairAgreement]], remaining: set[int]) -> set[int]:
    """Return the largest part of the remaining images that enough common points connect.

    A part grows from the image with the most common points. In each step, the images that enough common
    points connect with the part are added.
    """
    links = {
        image: {other: pair.agreeing for other, pair in partners[image].items() if pair.connects}
        for image in remaining
    }
    best: set[int] = set()
    while remaining:
        seed = max(remaining, key=lambda image: (sum(links[image].values()), -image))
        part, support = set[int](), dict[int, int]()
        added = {seed}
        while added:
            part |= added
            for image in added:
                for other, count in links[image].items():
                    support[other] = support.get(other, 0) + count
            added = {
                image
                for image, count in support.items()
                if image in remaining and image not in part and count >= _MIN_SUPPORT
            }
        best = max(best, part, key=len)
        remaining = remaining - part
    return best
