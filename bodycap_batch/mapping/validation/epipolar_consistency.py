"""Compare verified pairs with a map's poses, to find misregistered keyframes and inconsistent maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.percent import format_percent
from bodycap_batch.mapping.matching.database import DATABASE_NAME
from bodycap_batch.mapping.matching.near_pairs import NO_TIMES, NearPairs
from bodycap_batch.model.optical_flow import pixel_scale

if TYPE_CHECKING:
    import pycolmap

_MAX_ERROR_PX = 8.0
"""Maximum epipolar error, in px of an image with a long side of 640 px, of a match that the map's poses
explain. This is twice the maximum error in the verification of pairs. The error may be larger than in
verification because a map is slightly deformed."""
_MIN_PAIR_MATCHES = 30
"""Minimum number of matches of an evaluated pair. Some verified pairs with fewer matches are wrong.
Evidence: none."""
_MIN_INLIER_RATIO = 0.5
"""Minimum fraction of a pair's matches that the map's poses must explain. A pair with a smaller fraction is
inconsistent. Evidence: none."""
_MAX_IMAGE_INCONSISTENT_RATIO = 0.25
"""Maximum fraction of an image's matches that may be in inconsistent pairs. An image with a larger fraction
is misregistered. Evidence: none."""

MAX_INCONSISTENT_RATIO = 0.1
"""Maximum fraction of a map's matches that may be in inconsistent pairs. A map with a larger fraction is
refused. Evidence: docs/decisions/mapping.md."""


@dataclass(frozen=True, slots=True)
class PairConsistency:
    """A verified pair, and the fraction of its matches that the map's poses explain.

    Attributes:
        first: Id of the pair's first image.
        second: Id of the pair's second image.
        matches: Number of verified matches.
        inlier_ratio: Fraction of the verified matches that the map's poses explain.
    """

    first: int
    second: int
    matches: int
    inlier_ratio: float

    @property
    def is_inconsistent(self) -> bool:
        """Whether the map's poses explain too few of the pair's matches."""
        return self.inlier_ratio < _MIN_INLIER_RATIO


def evaluate_pairs(
    workspace: Path, model: pycolmap.Reconstruction, times_ns: Mapping[str, IntArray] = NO_TIMES
) -> list[PairConsistency]:
    """Compare the matches of verified pairs with the epipolar geometry that the model's poses define.

    Pairs are evaluated if both images are registered and the pair has at least `_MIN_PAIR_MATCHES` matches.
    Of a pair that is near in time (`near_pairs`), only the matches that the poses explain count.

    Args:
        workspace: Folder of the database.
        model: The model.
        times_ns: Times (N,) of all frames of each camera, nanoseconds, by camera name.

    Source: the Sampson distance of Hartley, Zisserman, "Multiple view geometry", 2004, 11.4.
    """
    import pycolmap

    poses = {int(i): model.image(i).cam_from_world() for i in model.reg_image_ids()}
    near = NearPairs(model, times_ns)
    rays, focal_px, max_error_px = {}, {}, {}
    out = []
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        for image in database.read_all_images():
            number = int(image.image_id)
            if number in poses:
                camera = model.image(number).camera  # The model's intrinsics may be refined.
                pixels = np.asarray(database.read_keypoints(number), dtype=np.float64)[:, :2]
                rays[number] = np.asarray(camera.cam_from_img(pixels))
                focal_px[number] = camera.mean_focal_length()
                max_error_px[number] = _MAX_ERROR_PX * pixel_scale(camera.width, camera.height)
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            a, b = map(int, pycolmap.pair_id_to_image_pair(pair))
            matches = np.asarray(geometry.inlier_matches)
            if a in poses and b in poses and len(matches) >= _MIN_PAIR_MATCHES:
                essential = pycolmap.essential_matrix_from_pose(poses[b] * poses[a].inverse())
                squared = pycolmap.compute_squared_sampson_error(
                    rays[a][matches[:, 0]], rays[b][matches[:, 1]], essential
                )
                error_px = focal_px[a] * np.sqrt(squared)
                explained = int((error_px < max_error_px[a]).sum())
                count = explained if (a, b) in near else len(matches)
                if count >= _MIN_PAIR_MATCHES:
                    out.append(PairConsistency(a, b, count, explained / count))
    return out


def find_misregistered_images(pairs: Sequence[PairConsistency]) -> set[int]:
    """Return the ids of misregistered images: a small set that explains nearly all inconsistent pairs.

    In each step, the image with the largest fraction of matches in inconsistent pairs is added to the set. In
    the following steps, the inconsistent pairs of this image are ignored.

    This finds the images of a misregistered block, but not the correct images that match the block. The
    images of the block are inconsistent with most of their partners. A correct image is inconsistent only
    with the block, and its pairs with the block are ignored once the block is in the set.
    """
    total: dict[int, int] = {}
    wrong: dict[int, dict[int, int]] = {}
    for pair in pairs:
        for one, other in ((pair.first, pair.second), (pair.second, pair.first)):
            total[one] = total.get(one, 0) + pair.matches
            if pair.is_inconsistent:
                wrong.setdefault(one, {})[other] = pair.matches
    out: set[int] = set()
    while True:
        ratio = {
            image: sum(count for other, count in partners.items() if other not in out) / total[image]
            for image, partners in wrong.items()
            if image not in out
        }
        worst = max(sorted(ratio), key=lambda image: ratio[image], default=None)
        if worst is None or ratio[worst] <= _MAX_IMAGE_INCONSISTENT_RATIO:
            return out
        out.add(worst)


def inconsistent_match_ratio(pairs: Sequence[PairConsistency]) -> float:
    """Return the fraction of all matches of the given pairs that belong to inconsistent pairs."""
    wrong = sum(pair.matches for pair in pairs if pair.is_inconsistent)
    return wrong / max(1, sum(pair.matches for pair in pairs))


def find_contradicting_camera(pairs: Sequence[PairConsistency], cameras: Mapping[int, str]) -> str | None:
    """Return the one camera without which the matches of an inconsistent map are consistent.

    Args:
        pairs: The verified pairs of the map.
        cameras: Name of the camera of each image, by image id.

    Returns:
        The name of the camera; None if the map is consistent, or if not exactly one camera explains the
        inconsistent pairs.
    """
    if inconsistent_match_ratio(pairs) <= MAX_INCONSISTENT_RATIO:
        return None
    explained = []
    for name in sorted(set(cameras.values())):
        rest = [pair for pair in pairs if name not in (cameras[pair.first], cameras[pair.second])]
        if rest and inconsistent_match_ratio(rest) <= MAX_INCONSISTENT_RATIO:
            explained.append(name)
    return explained[0] if len(explained) == 1 else None


def contradicting_camera_note(camera: str) -> str:
    """Return the note for the user on a camera that was left out."""
    return (
        f"camera {camera} is left out: its matches contradict the map, and without this camera the map is "
        "consistent; check that its video is of the same recording, that its zoom did not change, and that "
        "its calibration is right"
    )


def check_consistency(ratio: float) -> EstimationError | None:
    """Return an error if a map contradicts many of its verified matches.

    The usual cause is a room with several parts that look the same.

    Args:
        ratio: `inconsistent_match_ratio` of the map.

    Returns:
        The error; None if the map is consistent enough.
    """
    if ratio <= MAX_INCONSISTENT_RATIO:
        return None
    return EstimationError(
        f"{format_percent(ratio)} of the matches between keyframes contradict the map: different places that "
        "look the same (repeated pictures, tiles, windows) were mapped as one place",
        hint="film objects that are different in each place, or cover repeated pictures; check the "
        "calibration",
    )


def check_coverage(
    models: Sequence[Any],
    keyframes: int,
    textured: int,
    attempts: Sequence[Mapping[str, object]],
    options: MapOptions,
) -> EstimationError | None:
    """Return an error if the largest model holds too few keyframes.

    Args:
        models: The models, largest first.
        keyframes: Number of keyframes of all cameras.
        textured: Number of these keyframes with enough features to be part of a map.
        attempts: The initial pairs that were tried, for the message, which names the first reason of failure.
        options: The stage's options. ``min_coverage`` is the minimum fraction of the keyframes with texture
            that the largest model must hold.

    Returns:
        The error; None if the largest model holds enough keyframes.
    """
    registered = models[0].num_reg_images() if models else 0
    reasons = [str(each[key]) for each in attempts for key in ("doubt", "failed") if key in each]
    because = f"; of the best pair of keyframes to start from, {reasons[0]}" if reasons else ""
    if registered >= max(2, options.min_coverage * textured):
        return None
    return EstimationError(
        f"the map contains only {registered} of {keyframes} keyframes, {textured} of which show texture; it "
        f"must contain at least {format_percent(options.min_coverage)} of these{because}",
        hint="move the cameras sideways past bright surfaces with texture; check the calibration",
    )
