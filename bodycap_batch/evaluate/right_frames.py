"""Find the delivered poses that fresh matches of the pictures confirm. No truth is needed.

Coverage rewards folded maps: a map that is folded onto itself has a pose for every frame. So delivered poses
are compared with measurements that neither the tracks nor the map use. Frames are linked if the pictures
confirm their relative rotation and position. The right frames of a camera are the largest set of frames that
is joined by such links and that no measurement contradicts.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.evaluate.fresh_features import FrameFeatures, match_features
from bodycap_batch.evaluate.three_view import judge_positions
from bodycap_batch.evaluate.two_view import (
    Motion,
    Outcome,
    RayMatches,
    differs,
    judge_rotation,
    measure_rotation,
)
from bodycap_batch.model.geometry import rotation_angle_rad

GAPS = {1: 1, 5: 1, 15: 3, 45: 3}
"""Distances in frames of the linked frames, and every how many frames a link starts."""
_LENS_ERROR = 0.02
"""Relative error of a turned angle through an error of the focal length. Evidence: none."""
_MAX_CHAIN_SIGMA_DEG = 5.0
"""Maximum standard deviation (degrees) of a chain of rotations across lost frames."""
_STEPS = (5, 3, 2, 1)
"""Distances in frames that one step of a chain may have, in the order in which they are tried. Between near
frames the pictures hardly tell a turn from a step to the side, and all errors have the same sign."""


_ROTATION_VOTES = {Outcome.RIGHT: 1, Outcome.UNMEASURABLE: 0, Outcome.WRONG: -30}
"""Votes of a pair's rotation for having its two frames in one set. A right rotation says nothing of
positions, so its vote is small: it joins frames whose positions are not measurable."""
_POSITION_VOTES = {Outcome.RIGHT: 10, Outcome.UNMEASURABLE: 0, Outcome.WRONG: -10}
"""Votes of three frames' positions for having each two of them in one set. A wrong triple does not say which
of its frames is wrong, so the votes are equal: near a leap, a frame has more right triples on its own
side."""
_REVISIT_EVERY = 15
"""Every how many frames earlier frames with a similar view are looked for."""
_REVISIT_FRAMES = 90
"""Minimum distance in frames of a revisit: farther than the longest of `GAPS`."""
_REVISIT_ANGLE_DEG = 30.0
"""Maximum angle (degrees) between the optical axes of two views of one place. Evidence: none."""
_REVISITS = 2
"""Number of earlier views that are compared with a frame. Evidence: none."""

Features = Sequence[FrameFeatures | None]
"""The features of each frame of a camera; None for a frame that cannot be decoded."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPair:
    """Two frames with their fresh matches.

    Attributes:
        rows: (M,2) indices of the matched features.
        measured: The rotation between the frames; None if it is not measurable.
    """

    rows: IntArray
    measured: Motion | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureEvidence:
    """What the pictures of one camera measure. It depends only on which frames have a pose.

    Attributes:
        features: The features of all N frames.
        pairs: The pairs of frames that are `GAPS` apart.
        chains: Rotation last_from_first and its covariance across each stretch of frames without a pose, from
            the rotations between the frames in it; None if it is not measurable.
    """

    features: Features
    pairs: Mapping[tuple[int, int], MeasuredPair]
    chains: Mapping[tuple[int, int], tuple[FloatArray, FloatArray] | None]


@dataclass(frozen=True, slots=True, kw_only=True)
class RightFrames:
    """The outcome for one camera.

    Attributes:
        outcome: (N,) outcome of each frame; None for a frame without a pose.
        links: Number of pairs of frames whose rotation was compared, by outcome.
        positions: Number of triples of frames whose positions were compared, by outcome.
    """

    outcome: tuple[Outcome | None, ...]
    links: Mapping[Outcome, int]
    positions: Mapping[Outcome, int]

    def count(self, outcome: Outcome) -> int:
        """Return the number of frames with an outcome."""
        return sum(each is outcome for each in self.outcome)


def measure_pictures(
    features: Features, posed: BoolArray, progress: Callable[[int, int], None] | None = None
) -> PictureEvidence:
    """Match the frames of one camera with each other.

    Args:
        features: The features of all N frames.
        posed: (N,) True for frames with a delivered pose.
        progress: Receives the number of finished frames and of all frames.
    """
    pairs: dict[tuple[int, int], MeasuredPair] = {}
    for first in range(len(posed)):
        if progress is not None:
            progress(first, len(posed))
        for gap, every in GAPS.items():
            second = first + gap
            if first % every == 0 and second < len(posed) and posed[first] and posed[second]:
                pairs[first, second] = measure_pair(features[first], features[second])
    ends = np.flatnonzero(posed)
    stretches = [(int(a), int(b)) for a, b in pairwise(ends) if b - a > 1]
    chains = {ends: _chain(features, *ends) for ends in stretches}
    return PictureEvidence(features=features, pairs=pairs, chains=chains)


def measure_pair(first: FrameFeatures | None, second: FrameFeatures | None) -> MeasuredPair:
    """Match two frames and measure their relative rotation."""
    if first is None or second is None:
        return MeasuredPair(rows=np.zeros((0, 2), dtype=np.int64), measured=None)
    rows = match_features(first, second)
    return MeasuredPair(rows=rows, measured=measure_rotation(_ray_matches(first, second, rows)))


def _ray_matches(first: FrameFeatures, second: FrameFeatures, rows: IntArray) -> RayMatches:
    return RayMatches(
        first=first.rays[rows[:, 0]],
        second=second.rays[rows[:, 1]],
        cells=first.cells[rows[:, 0]],
        noise_rad=np.maximum(first.pixel_rad[rows[:, 0]], second.pixel_rad[rows[:, 1]]),
    )


def _judge_pair(
    features: Features, frames: tuple[int, int], pair: MeasuredPair, world_from_cam: FloatArray
) -> tuple[Motion | None, Outcome]:
    """Compare the delivered rotation between two frames with their matches, as `judge_rotation` does."""
    first, second = features[frames[0]], features[frames[1]]
    if first is None or second is None:
        return None, Outcome.UNMEASURABLE
    expected = world_from_cam[frames[1], :3, :3].T @ world_from_cam[frames[0], :3, :3]
    return judge_rotation(_ray_matches(first, second, pair.rows), pair.measured, expected)


def find_right_frames(evidence: PictureEvidence, world_from_cam: FloatArray) -> RightFrames:
    """Compare the delivered poses of one camera with its pictures.

    Args:
        evidence: What the pictures measure.
        world_from_cam: (N,4,4) delivered poses; NaN for a frame without one.
    """
    posed = has_pose(world_from_cam)
    outcomes: dict[tuple[int, int], Outcome] = {}
    motions: dict[tuple[int, int], tuple[Motion, IntArray]] = {}
    for (first, second), pair in evidence.pairs.items():
        motion, outcome = _judge_pair(evidence.features, (first, second), pair, world_from_cam)
        outcomes[first, second] = outcome
        if motion is not None:
            motions[first, second] = motion, pair.rows[motion.inliers]
    for (first, last), chain in evidence.chains.items():
        expected = world_from_cam[last, :3, :3].T @ world_from_cam[first, :3, :3]
        if chain is not None:
            outcomes[first, last] = Outcome.WRONG if differs(*chain, expected) else Outcome.RIGHT
        else:
            outcomes[first, last] = Outcome.UNMEASURABLE
    outcomes |= _revisits(evidence.features, world_from_cam, posed)
    positions = _position_outcomes(evidence.features, world_from_cam[:, :3, 3], motions)
    votes: dict[tuple[int, int], int] = defaultdict(int)
    for key, outcome in outcomes.items():
        votes[key] += _ROTATION_VOTES[outcome]
    for frames, outcome in positions.items():
        if any(outcomes[pair] is not Outcome.RIGHT for pair in pairwise(frames)):
            continue
        for key in combinations(frames, 2):
            votes[key] += _POSITION_VOTES[outcome]
    labels = _clusters(votes, np.flatnonzero(posed))
    return RightFrames(
        outcome=_frame_outcomes(labels, votes, posed),
        links=Counter(outcomes.values()),
        positions=Counter(positions.values()),
    )


def has_pose(world_from_cam: FloatArray) -> BoolArray:
    """Return a mask (N,) of the poses (N,4,4) that are known: those of lost frames are NaN."""
    return np.asarray(np.isfinite(world_from_cam).all(axis=(1, 2)))


def _position_outcomes(
    features: Features, centres: FloatArray, motions: Mapping[tuple[int, int], tuple[Motion, IntArray]]
) -> dict[tuple[int, int, int], Outcome]:
    """Compare the positions of each three frames at equal distances.

    Args:
        features: The features of all frames.
        centres: (N,3) delivered camera centres.
        motions: The measured motion of each pair, and the indices (K,2) of the features that follow it.
    """
    found: dict[tuple[int, int, int], Outcome] = {}
    for (first, second), (before, before_rows) in motions.items():
        frames = (first, second, 2 * second - first)
        if frames[1:] not in motions:
            continue
        after, after_rows = motions[frames[1:]]
        _, one, two = np.intersect1d(before_rows[:, 1], after_rows[:, 0], return_indices=True)
        chosen = (before_rows[one, 0], before_rows[one, 1], after_rows[two, 1])
        seen = [features[index] for index in frames]
        rays = [each.rays[row] for each, row in zip(seen, chosen, strict=True) if each is not None]
        middle = seen[1]
        if middle is not None and len(rays) == 3:
            lengths = np.linalg.norm(np.diff(centres[list(frames)], axis=0), axis=1)
            found[frames] = judge_positions(
                rays,
                (before, after),
                (float(lengths[0]), float(lengths[1])),
                middle.pixel_rad[chosen[1]],
                middle.cells[chosen[1]],
            )
    return found


def _chain(features: Features, first: int, last: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the rotation last_from_first through the frames between, and its covariance, if it is exact."""
    rotation, sigma, turned = np.eye(3), 0.0, 0.0
    index = first
    while index < last:
        steps = (min(index + step, last) for step in _STEPS)
        tried = ((end, measure_pair(features[index], features[end]).measured) for end in steps)
        end, measured = next((pair for pair in tried if pair[1] is not None), (index, None))
        if measured is None:
            return None
        turn = measured.rotation
        rotation = turn @ rotation
        # The errors of the steps have a common part, so their standard deviations are added.
        sigma += np.deg2rad(measured.sigma_deg)
        turned += float(rotation_angle_rad(turn))
        index = end
    variance = sigma**2 + (_LENS_ERROR * turned) ** 2
    is_exact = variance < np.deg2rad(_MAX_CHAIN_SIGMA_DEG) ** 2
    return (rotation, variance * np.eye(3)) if is_exact else None


def _revisits(
    features: Features, world_from_cam: FloatArray, posed: BoolArray
) -> dict[tuple[int, int], Outcome]:
    """Compare frames with earlier ones that see the same place, if the delivered poses are right."""
    frames = np.flatnonzero(posed)[::_REVISIT_EVERY]
    axes, centres = world_from_cam[frames, :3, 2], world_from_cam[frames, :3, 3]
    outcomes: dict[tuple[int, int], Outcome] = {}
    for number, second in enumerate(frames):
        is_similar = axes @ axes[number] > np.cos(np.deg2rad(_REVISIT_ANGLE_DEG))
        is_similar &= frames <= second - _REVISIT_FRAMES
        distance = np.where(is_similar, np.linalg.norm(centres - centres[number], axis=1), np.inf)
        for other in np.argsort(distance, kind="stable")[: min(_REVISITS, np.count_nonzero(is_similar))]:
            first = int(frames[other])
            pair = measure_pair(features[first], features[second])
            outcomes[first, int(second)] = _judge_pair(features, (first, int(second)), pair, world_from_cam)[
                1
            ]
    return outcomes


def _clusters(votes: Mapping[tuple[int, int], int], frames: IntArray) -> dict[int, int]:
    """Join frames by right links, unless more measurements contradict the union than confirm it.

    Returns:
        The label of each frame.
    """
    label = {int(frame): int(frame) for frame in frames}
    members = {int(frame): [int(frame)] for frame in frames}
    net: dict[int, dict[int, int]] = {int(frame): defaultdict(int) for frame in frames}
    for (first, second), vote in votes.items():
        net[first][second] += vote
        net[second][first] += vote
    for first, second in sorted(votes, key=lambda pair: (-votes[pair], pair[1] - pair[0], pair)):
        one, two = label[first], label[second]
        if one == two or net[one].get(two, 0) <= 0:
            continue
        if len(members[one]) < len(members[two]):
            one, two = two, one
        for frame in members[two]:
            label[frame] = one
        members[one] += members.pop(two)
        for other, vote in net.pop(two).items():
            net[other].pop(two, None)
            if other != one:
                net[one][other] += vote
                net[other][one] = net[one][other]
    return label


def _frame_outcomes(
    labels: Mapping[int, int], votes: Mapping[tuple[int, int], int], posed: BoolArray
) -> tuple[Outcome | None, ...]:
    """Return the outcome of each frame: right in the largest set, wrong if a measurement contradicts it."""
    sizes: dict[int, int] = defaultdict(int)
    for cluster in labels.values():
        sizes[cluster] += 1
    largest = max(sizes, key=lambda cluster: (sizes[cluster], -cluster), default=-1)
    contradicted = {labels[frame] for pair, vote in votes.items() if vote < 0 for frame in pair}
    out: list[Outcome | None] = []
    for frame, has_pose in enumerate(posed):
        if not has_pose:
            out.append(None)
            continue
        cluster = labels[frame]
        if cluster == largest and sizes[largest] > 1:
            out.append(Outcome.RIGHT)
        else:
            out.append(Outcome.WRONG if cluster in contradicted else Outcome.UNMEASURABLE)
    return tuple(out)
