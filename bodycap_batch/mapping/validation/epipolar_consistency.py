"""Verified pairs that a map contradicts: where a block of it stands in the wrong place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.matching.database import DATABASE_NAME

if TYPE_CHECKING:
    import pycolmap

_MAX_ERROR_PX = 8.0
"""Twice the error that verification allows: a map bends a little, its pairs do not."""
_MIN_PAIR_MATCHES = 30
"""Pairs with fewer are now and then wrong themselves."""
_MIN_INLIER_RATIO = 0.5
"""Share of a pair's matches that the map's poses have to explain."""
_MAX_IMAGE_INCONSISTENT_RATIO = 0.25
"""Share of a keyframe's matches in contradicted pairs above which its place is doubted."""

MAX_INCONSISTENT_RATIO = 0.1
"""Right maps of nine captures: 0 to 0.9 %. A bare room with three pictures hung again and again, folded onto
itself by a metre: 22 %."""


@dataclass(frozen=True, slots=True)
class PairConsistency:
    """A verified pair and what the map makes of it."""

    first: int
    second: int
    inliers: int
    agreeing: float


def evaluate_pairs(workspace: Path, model: pycolmap.Reconstruction) -> list[PairConsistency]:
    """Hold every verified pair of registered keyframes against the map's poses.

    Source: the symmetric epipolar distance of Hartley, Zisserman, "Multiple view geometry", 2004, 11.4.
    """
    import pycolmap

    poses = {int(i): np.asarray(model.image(i).cam_from_world().matrix()) for i in model.reg_image_ids()}
    rays, focal = {}, {}
    out = []
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for image in database.read_all_images():
            number = int(image.image_id)
            if number in poses:
                lens = model.image(number).camera  # a guessed one was refined
                pixels = np.asarray(database.read_keypoints(number), dtype=np.float64)[:, :2]
                rays[number] = np.column_stack([lens.cam_from_img(pixels), np.ones(len(pixels))])
                focal[number] = lens.mean_focal_length()
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            a, b = map(int, pycolmap.pair_id_to_image_pair(pair))
            matches = np.asarray(geometry.inlier_matches)
            if a in poses and b in poses and len(matches) >= _MIN_PAIR_MATCHES:
                error = focal[a] * _epipolar(
                    rays[a][matches[:, 0]], rays[b][matches[:, 1]], poses[a], poses[b]
                )
                out.append(PairConsistency(a, b, len(matches), float((error < _MAX_ERROR_PX).mean())))
    return out


def _epipolar(first: FloatArray, second: FloatArray, pose_a: Any, pose_b: Any) -> FloatArray:
    """Sampson distance of rays (M,3) at depth 1 under two poses cam_from_map (3,4)."""
    turn = pose_b[:, :3] @ pose_a[:, :3].T
    shift = pose_b[:, 3] - turn @ pose_a[:, 3]
    x, y, z = shift / max(float(np.linalg.norm(shift)), 1e-12)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    lines_b, lines_a = first @ essential.T, second @ essential
    numerator = np.abs((second * lines_b).sum(axis=1))
    slope = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(numerator / np.sqrt(np.maximum(slope, 1e-18)))


def find_misregistered_images(links: Sequence[PairConsistency]) -> set[int]:
    """Keyframes in the wrong place: the fewest whose removal leaves no contradiction of weight.

    Greedily takes out the keyframe with the largest share of its matches in contradicted pairs: a misplaced
    block contradicts most of what it is tied to, each of its partners contradicts the block only.
    """
    total: dict[int, int] = {}
    wrong: dict[int, dict[int, int]] = {}
    for link in links:
        for one, other in ((link.first, link.second), (link.second, link.first)):
            total[one] = total.get(one, 0) + link.inliers
            if link.agreeing < _MIN_INLIER_RATIO:
                wrong.setdefault(one, {})[other] = link.inliers
    out: set[int] = set()
    while True:
        share = {
            image: sum(count for other, count in partners.items() if other not in out) / total[image]
            for image, partners in wrong.items()
            if image not in out
        }
        worst = max(sorted(share), key=lambda image: share[image], default=None)
        if worst is None or share[worst] <= _MAX_IMAGE_INCONSISTENT_RATIO:
            return out
        out.add(worst)


def inconsistent_match_ratio(links: Sequence[PairConsistency]) -> float:
    """Share of all matches in verified pairs that belong to pairs the map contradicts."""
    wrong = sum(link.inliers for link in links if link.agreeing < _MIN_INLIER_RATIO)
    return wrong / max(1, sum(link.inliers for link in links))


def check_consistency(share: float, reach: Mapping[str, object] | None) -> EstimationError | None:
    """What to say of a map that a good part of its own pairs contradict: rooms whose parts look the same.

    Args:
        share: `inconsistent_match_ratio` of the map.
        reach: What the body's reach says, if there is a body.

    Returns:
        The error; None where the map can be right.
    """
    if share <= MAX_INCONSISTENT_RATIO:
        return None
    body = ""
    if reach is not None:
        found = reach.get("reason", f"{reach.get('keyframes_out_of_reach')} keyframes out of it")
        body = f"; the body's reach: {found}"
    return EstimationError(
        f"{share:.0%} of the matches between keyframes contradict the map: places that look the same "
        f"(repeated pictures, tiles, windows) were taken for one{body}",
        hint="film what tells the places apart, or cover repeated pictures; check the calibration",
    )


def check_coverage(
    models: Sequence[Any], keyframes: int, ladder: object, options: MapOptions
) -> EstimationError | None:
    """What to say of models that hold too few of the keyframes; None where they hold enough."""
    registered = models[0].num_reg_images() if models else 0
    if registered >= max(2, options.min_coverage * keyframes):
        return None
    return EstimationError(
        f"the map holds {registered} of {keyframes} keyframes, "
        f"fewer than {options.min_coverage:.0%}; initial pairs: {ladder}",
        hint="film sideways movement over textured, well lit surfaces; check the calibration",
    )
