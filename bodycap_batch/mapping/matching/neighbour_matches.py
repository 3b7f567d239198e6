"""Give each keyframe as many features, and neighbours as near, as its matching needs.

A map holds together by the matches of keyframes that are neighbours in time. A room with much texture has
enough of them with few features and distant keyframes. Where neighbours have few matches, their pictures get
more features, and then further keyframes between them. So a capture pays only where it is hard.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.pair_matching import (
    KeyframeFeatures,
    find_mutual_matches,
    verify_pair,
)
from bodycap_batch.mapping.matching.sift import SiftFeatures, extract_features

_MIN_MATCHES = 100
"""Number of verified matches with which neighbours are connected well. Evidence: docs/decisions/tracks.md."""
_MIN_SHARE = 0.25
"""Share of the features of the poorer picture that is enough, too. A bare wall has few features, and no
number of keyframes gives more. Evidence: docs/decisions/tracks.md."""
MORE_FEATURES = 4
"""Factor of the number of features of a keyframe with few matches. Evidence: docs/decisions/tracks.md."""
_ROUNDS = 3
"""Maximum number of times that the gap between neighbours is halved: from 0.5 s to two frames of a usual
video."""


def features_for_neighbours(
    camera: CaptureCamera, frames: IntArray, sharpness: FloatArray, count: int, context: StageContext
) -> dict[int, SiftFeatures]:
    """Return the features of keyframes and of further frames between them, by frame index in time order.

    Args:
        camera: Camera whose frames are read.
        frames: (K,) frame indices of the keyframes, increasing.
        sharpness: (N,) sharpness of each frame of the video; NaN for a frame that cannot be a keyframe.
        count: Maximum number of features of a keyframe that has enough matches.
        context: Threads, progress and cancellation.
    """
    found = _extract(camera, frames, count, context)
    if not is_on(Mechanism.NEIGHBOUR_MATCHES):
        return found
    matches = _Matches(camera, context)
    # A picture with fewer features than half of the maximum has no more.
    poor = {
        frame for pair in matches.weak(found) for frame in pair if 2 * len(found[frame].keypoints) >= count
    }
    found |= _extract(camera, np.array(sorted(poor), dtype=np.int64), MORE_FEATURES * count, context)
    record_act(Mechanism.NEIGHBOUR_MATCHES, len(poor))
    for _ in range(_ROUNDS):
        between = {_sharpest_between(*pair, sharpness) for pair in matches.weak(found)} - {None}
        added = np.array(sorted(frame for frame in between if frame is not None), dtype=np.int64)
        if not len(added):
            break
        found |= _extract(camera, added, MORE_FEATURES * count, context)
        record_act(Mechanism.NEIGHBOUR_MATCHES, len(added))
    return dict(sorted(found.items()))


def _extract(
    camera: CaptureCamera, frames: IntArray, count: int, context: StageContext
) -> dict[int, SiftFeatures]:
    """Return the features of some frames, by frame index."""
    out = dict[int, SiftFeatures]()
    for frame, features in extract_features(camera, frames, count, context):
        out[frame] = features
        context.progress(len(out), len(frames), f"features of {camera.name}")
    return out


class _Matches:
    """Counts the verified matches of neighbours. Each pair is matched again only if its features changed."""

    def __init__(self, camera: CaptureCamera, context: StageContext) -> None:
        self._intrinsics = CameraIntrinsics(camera.camera, camera.calibrated)
        self._context = context
        self._known = dict[tuple[int, int], tuple[int, int]]()

    def weak(self, features: dict[int, SiftFeatures]) -> list[tuple[int, int]]:
        """Return the neighbours with too few matches."""
        pairs = list(pairwise(sorted(features)))
        changed = [pair for pair in pairs if self._known.get(pair, (-1, 0))[0] != _size(features, pair)]
        with ThreadPoolExecutor(self._context.threads) as pool:
            counts = list(pool.map(lambda pair: self._count(features, pair), changed))
        for pair, matched in zip(changed, counts, strict=True):
            self._known[pair] = _size(features, pair), matched
        return [pair for pair in pairs if self._known[pair][1] < _needed(features, pair)]

    def _count(self, features: dict[int, SiftFeatures], pair: tuple[int, int]) -> int:
        self._context.check_cancelled()
        one, other = (
            KeyframeFeatures.of(
                features[frame].keypoints[:, :2].astype(np.float64),
                features[frame].descriptors,
                self._intrinsics,
            )
            for frame in pair
        )
        matches = find_mutual_matches(
            one.descriptors.astype(np.float32), other.descriptors.astype(np.float32)
        )
        return len(verify_pair(matches, one, other).matches)


def _size(features: dict[int, SiftFeatures], pair: Sequence[int]) -> int:
    """Return the number of features of both pictures of a pair."""
    return sum(len(features[frame].keypoints) for frame in pair)


def _needed(features: dict[int, SiftFeatures], pair: Sequence[int]) -> float:
    """Return the number of matches with which a pair is connected well."""
    return min(_MIN_MATCHES, _MIN_SHARE * min(len(features[frame].keypoints) for frame in pair))


def _sharpest_between(first: int, last: int, sharpness: FloatArray) -> int | None:
    """Return the sharpest frame in the middle third between two frames; None if there is none."""
    third = (last - first) / 3.0
    start, stop = int(np.ceil(first + third)), int(np.floor(last - third)) + 1
    frames = np.arange(max(start, first + 1), min(stop, last))
    usable = frames[np.isfinite(sharpness[frames])]
    return int(usable[np.argmax(sharpness[usable])]) if len(usable) else None
