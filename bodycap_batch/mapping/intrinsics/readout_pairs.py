"""Estimate readout times from pairs of keyframes, where the matches between adjacent frames do not suffice.

Two keyframes see the same points while the camera turns at different velocities. Keypoints that are corrected
for the right readout time therefore agree better with one two-view geometry. The verified matches are counted
for a few readout times.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.intrinsics.readout_time import Readout, few_blocks_factor, weighted_mean
from bodycap_batch.mapping.intrinsics.shutters import (
    MAX_DISPLACEMENT_PX,
    grid_displacement_px,
    turning_shutters,
)
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.descriptors import ByteDescriptors
from bodycap_batch.mapping.matching.pair_matching import (
    MIN_INLIERS,
    KeyframeFeatures,
    find_mutual_matches,
    verify_pair,
)
from bodycap_batch.mapping.matching.pair_selection import PairGenerator
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import KeyframeSelection

_STEP_S = 0.004
"""Distance of the readout times for which matches are counted, seconds. Origin: the largest standard
deviation of a readout time that adjacent frames determine."""
_MAX_STEPS = 6
"""Maximum number of steps from the readout time of adjacent frames to the one with the most matches.
Evidence: none."""
_MAX_ERROR_PX = 1.0
"""Maximum epipolar error of a counted match, px of an image with a long side of 640 px. With the 4 px of the
map, a two-view geometry absorbs most of the displacements. Evidence: docs/decisions/mapping.md."""
_MAX_KEYFRAMES = 200
"""Maximum number of keyframes in the sample. It bounds the time."""
_MAX_PAIRS = 600
"""Maximum number of pairs in the sample. It bounds the time. Evidence: docs/decisions/mapping.md."""
_MAX_TRIED = 2400
"""Maximum number of pairs whose features are compared to find this sample. It bounds the time."""
_PAIRS_AT_ONCE = 64
"""Number of pairs whose features are compared between two looks at the size of the sample. The sample does
not depend on it."""
_MIN_DECIDING = 20
"""Minimum number of pairs with another number of matches than without the correction. Evidence: none."""
_MIN_STEPS_APART = 5
"""Minimum number of steps, from keyframe to keyframe, between two keyframes of one camera in a pair. Nearer
keyframes see nearly the same picture (pair_selection)."""
_BLOCK_S = 0.5
"""Length of a block of successive keyframes of a camera, seconds. Blocks are the independent samples from
which standard deviations are estimated. It is the same as in readout_profile."""
_MIN_BLOCKS = 4
"""Minimum number of blocks for a standard deviation. Evidence: none."""
_FLOOR_SIGMA_STEPS = 0.29
"""Minimum standard deviation of the maximum of a parabola, in steps. Origin: the place is known to one step,
and a uniform distribution over one step has a standard deviation of 1 / sqrt(12)."""
_MIN_SIGMAS = 3.0
"""Minimum advantage of a readout time over 0, in its standard deviations. If both are equally good, chance
reaches it in 0.13 % of the comparisons. The readout time with the most matches of up to nine is compared, so
the rate of false alarms is at most 1.2 %."""


@dataclass(frozen=True, slots=True)
class _Sample:
    """Pairs of keyframes with their putative matches, and the features of the keyframes.

    Attributes:
        pairs: P pairs of keyframes.
        matches: For each pair, the putative matches (M,2), as indices of features.
        px: By keyframe, the detected positions (N,2) of its features, px.
        descriptors: By keyframe, the descriptors (N,128) of its features.
        blocks: (P,2) numbers of the blocks to which the keyframes of each pair belong.
    """

    pairs: list[Pair]
    matches: list[IntArray]
    px: dict[ImageRef, FloatArray]
    descriptors: dict[ImageRef, ByteDescriptors]
    blocks: IntArray

    def counts(
        self,
        shutters: Mapping[str, TurningShutter],
        intrinsics: Mapping[str, CameraIntrinsics],
        threads: int,
    ) -> IntArray:
        """Return the numbers (P,) of verified matches after a correction.

        Args:
            shutters: By camera name, what corrects the keypoints for a rolling shutter.
            intrinsics: Intrinsics by camera name.
            threads: Number of threads.
        """
        features = {}
        for ref in {ref for pair in self.pairs for ref in pair}:
            px, shutter = self.px[ref], shutters.get(ref.camera)
            if shutter is not None:
                px = shutter.px_at_mid_row(np.full(len(px), ref.frame, np.int64), px)
            features[ref] = KeyframeFeatures.of(
                px, self.descriptors[ref], intrinsics[ref.camera], _MAX_ERROR_PX
            )

        def count(number: int) -> int:
            a, b = self.pairs[number]
            return len(verify_pair(self.matches[number], features[a], features[b]))

        with ThreadPoolExecutor(threads) as pool:
            return np.array(list(pool.map(count, range(len(self.pairs)))), dtype=np.int64)


def doubtful_groups(
    capture: Capture, selections: Sequence[KeyframeSelection], readouts: Mapping[str, Readout]
) -> list[list[str]]:
    """Return the cameras whose undetermined readout times would displace keypoints far.

    Args:
        capture: All cameras.
        selections: Keyframes of each camera, with the matches between adjacent frames.
        readouts: Readout times from these matches, by camera name.

    Returns:
        Groups of names of the cameras that share one readout time.
    """
    trial = {
        name: replace(readout, seconds=readout.best_s)
        for name, readout in readouts.items()
        if not readout.determined and np.isfinite(readout.sigma_s)
    }
    shutters = turning_shutters(capture, selections, trial)
    groups: dict[tuple[float, float], list[str]] = {}
    for selection in selections:
        if selection.camera in shutters:
            readout = readouts[selection.camera]
            groups.setdefault((readout.best_s, readout.sigma_s), []).append(selection.camera)
    frames = {item.camera: np.asarray(item.frames) for item in selections}
    return [
        names
        for names in groups.values()
        if max(grid_displacement_px(shutters[name], frames[name]) for name in names) > MAX_DISPLACEMENT_PX
    ]


def sampled_keyframes(
    selections: Sequence[KeyframeSelection], cameras: Collection[str]
) -> list[KeyframeSelection]:
    """Return the selections of some cameras with evenly spaced keyframes, some `_MAX_KEYFRAMES` in total."""
    own = [item for item in selections if item.camera in cameras]
    share = min(1.0, _MAX_KEYFRAMES / max(1, sum(len(item.frames) for item in own)))
    out = []
    for item in own:
        count = len(item.frames)
        kept = np.unique(np.linspace(0, count - 1, max(1, round(share * count))).round().astype(np.int64))
        out.append(replace(item, frames=np.asarray(item.frames)[kept[kept < count]]))
    return out


def estimate_from_pairs(
    workspace: Path,
    capture: Capture,
    selections: Sequence[KeyframeSelection],
    readouts: Mapping[str, Readout],
    context: StageContext,
    generator: PairGenerator,
) -> dict[str, Readout]:
    """Estimate the common readout time of a group of cameras from pairs of their keyframes.

    Args:
        workspace: Folder of a database with the features of keyframes, which were not corrected.
        capture: All cameras.
        selections: The keyframes of the cameras of the group, with the matches between adjacent frames.
        readouts: The undetermined readout times from these matches, by camera name. They are equal.
        context: Cancellation.
        generator: Gives pairs of the keyframes.

    Returns:
        By camera name, the readout times. Each is the mean of both estimates, if the pairs have significantly
        more verified matches with the correction. Otherwise the readout time is unchanged.
    """
    names = [item.camera for item in selections]
    intrinsics = {
        name: CameraIntrinsics(capture.camera(name).camera, capture.camera(name).calibrated) for name in names
    }
    out = {name: readouts[name] for name in names}
    sample = _read_sample(workspace, generator, capture, names, context)
    if len(np.unique(sample.blocks)) < _MIN_BLOCKS:
        return out
    first = readouts[names[0]]

    def shutters(step: int) -> dict[str, TurningShutter]:
        seconds = first.best_s + step * _STEP_S
        return turning_shutters(
            capture, selections, {name: replace(out[name], seconds=seconds) for name in names}
        )

    known: dict[int, IntArray] = {}

    def counts(step: int) -> IntArray:
        context.check_cancelled()
        if step not in known:
            known[step] = sample.counts(shutters(step), intrinsics, context.threads)
        return known[step]

    best = _best_step(counts)
    interval_s = min(float(np.median(np.diff(capture.camera(name).times_ns))) * 1e-9 for name in names)
    uncorrected = sample.counts({}, intrinsics, context.threads)
    if not advantage_sigmas(counts(best), uncorrected, sample.blocks) >= _MIN_SIGMAS:
        return out
    place, sigma = _peak(np.stack([counts(best + step) for step in (-1, 0, 1)]), sample.blocks)
    value = np.array([first.best_s, first.best_s + (best + place) * _STEP_S])
    sigma_s = np.array([first.sigma_s, sigma * _STEP_S])
    best_s, mean_sigma_s = weighted_mean(value, sigma_s)
    if (
        abs(value[1] - value[0]) > _MIN_SIGMAS * float(np.hypot(*sigma_s))
        or not 0.0 < abs(best_s) < interval_s
    ):
        return out
    return {
        name: Readout(best_s, mean_sigma_s, "estimated", best_s, readouts[name].sideways) for name in names
    }


def _read_sample(
    workspace: Path,
    generator: PairGenerator,
    capture: Capture,
    cameras: Collection[str],
    context: StageContext,
) -> _Sample:
    """Return pairs of keyframes of some cameras that may see the same points from different places."""
    import pycolmap

    position: dict[ImageRef, int] = {ref: number for number, ref in enumerate(sorted(generator.refs))}
    pairs = [
        (a, b)
        for a, b in generator.initial_pairs()
        if {a.camera, b.camera} <= set(cameras)
        and (a.camera != b.camera or position[b] - position[a] >= _MIN_STEPS_APART)
    ]
    order = np.random.default_rng(0).permutation(len(pairs))[:_MAX_TRIED]
    used: list[Pair] = []
    found: list[IntArray] = []
    px: dict[ImageRef, FloatArray] = {}
    descriptors: dict[ImageRef, ByteDescriptors] = {}
    with (
        pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database,
        ThreadPoolExecutor(context.threads) as pool,
    ):
        ids = read_image_ids(database)
        for start in range(0, len(order), _PAIRS_AT_ONCE):
            context.check_cancelled()
            batch = [pairs[number] for number in order[start : start + _PAIRS_AT_ONCE].tolist()]
            for ref in {ref for pair in batch for ref in pair} - px.keys():
                px[ref] = np.asarray(database.read_keypoints(ids[ref]), dtype=np.float64)[:, :2]
                descriptors[ref] = np.asarray(database.read_descriptors(ids[ref]).data)
            matches = pool.map(
                lambda pair: find_mutual_matches(*(descriptors[ref].astype(np.float32) for ref in pair)),
                batch,
            )
            for pair, own in zip(batch, matches, strict=True):
                if len(own) >= MIN_INLIERS and len(used) < _MAX_PAIRS:
                    used.append(pair)
                    found.append(own)
            if len(used) == _MAX_PAIRS:
                break
    numbers: dict[tuple[str, int], int] = {}
    times = {name: capture.camera(name).times_ns for name in cameras}
    blocks = [
        [
            numbers.setdefault(
                (ref.camera, int(times[ref.camera][ref.frame] * 1e-9 / _BLOCK_S)), len(numbers)
            )
            for ref in pair
        ]
        for pair in used
    ]
    return _Sample(used, found, px, descriptors, np.array(blocks, dtype=np.int64).reshape(-1, 2))


def _best_step(counts: Callable[[int], IntArray]) -> int:
    """Return the step with more matches than both neighbours, on the way of the most matches from step 0."""
    best = 0
    for _ in range(_MAX_STEPS):
        better = max((best, best - 1, best + 1), key=lambda step: int(counts(step).sum()))
        if better == best:
            break
        best = better
    return best


def advantage_sigmas(corrected: IntArray, uncorrected: IntArray, blocks: IntArray) -> float:
    """Return how much better a correction is than none, in standard deviations.

    It is the ratio of pairs with more matches minus that of pairs with fewer matches. Its standard deviation
    is that of independent pairs, or that of the blocks if this is larger.

    Args:
        corrected: (P,) numbers of verified matches of pairs with the correction.
        uncorrected: (P,) the same numbers without the correction.
        blocks: (P,2) numbers of the blocks to which the keyframes of each pair belong.
    """
    sign = np.sign(corrected - uncorrected)
    deciding = int((sign != 0).sum())
    if deciding < _MIN_DECIDING:
        return 0.0

    def balance(kept: IntArray) -> float:
        return float(sign[kept].sum() / max(1, (sign[kept] != 0).sum()))

    value, sigma = _with_sigma(balance, blocks)
    return value / max(sigma, float(1.0 / np.sqrt(deciding)))


def _peak(counts: IntArray, blocks: IntArray) -> tuple[float, float]:
    """Return the place of the maximum of the matches, and its standard deviation, in steps.

    Args:
        counts: (3,P) numbers of verified matches of pairs, at -1, 0 and 1 steps.
        blocks: (P,2) numbers of the blocks to which the keyframes of each pair belong.
    """

    def place(kept: IntArray) -> float:
        left, middle, right = counts[:, kept].sum(axis=1).astype(float)
        bend = 2.0 * middle - left - right
        return float(np.clip(0.5 * (right - left) / bend, -1.0, 1.0)) if bend > 0.0 else 0.0

    value, sigma = _with_sigma(place, blocks)
    return value, max(sigma, _FLOOR_SIGMA_STEPS)


def _with_sigma(statistic: Callable[[IntArray], float], blocks: IntArray) -> tuple[float, float]:
    """Return a statistic of pairs and its standard deviation, by leaving out one block after the other.

    Args:
        statistic: The statistic of the pairs with some indices.
        blocks: (P,2) numbers of the blocks to which the keyframes of each pair belong. All pairs with a
            keyframe in a block are left out together.

    Source: Snijders, Borgatti, "Non-parametric standard errors and tests for network statistics", 1999, for
        the jackknife of pairs.
    """
    numbers = np.unique(blocks)
    without = np.array([statistic(np.flatnonzero((blocks != number).all(axis=1))) for number in numbers])
    variance = (len(numbers) - 1) / len(numbers) * ((without - without.mean()) ** 2).sum()
    return statistic(np.arange(len(blocks))), few_blocks_factor(len(numbers)) * float(np.sqrt(variance))
