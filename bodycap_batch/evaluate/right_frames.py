"""Find the delivered poses that fresh matches of the pictures confirm. No truth is needed.

Coverage rewards folded maps: a map that is folded onto itself has a pose for every frame. So delivered poses
are compared with measurements that neither the tracks nor the map use. Frames are linked if the pictures
confirm their relative rotation and position. The right frames of a camera are the largest set of frames that
is joined by such links and that no measurement contradicts.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.evaluate.breaks import contradicted_times, scale_jumps
from bodycap_batch.evaluate.fresh_features import FrameFeatures, match_features
from bodycap_batch.evaluate.three_view import CommonRays, Legs, judge_legs, measure_legs
from bodycap_batch.evaluate.two_view import WRONG_DEG, Outcome, judge_rotation
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp, so3_log
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.tracks.relative_motion import Motion, RayMatches, measure_rotation

GAPS = {1: 1, 5: 1, 15: 3, 45: 3}
"""Distances in frames of the linked frames, and every how many frames a link starts."""
_MAX_READOUT_TURN_DEG = 2.0
"""Maximum turn (degrees) during the readout of a frame whose points are used for positions. Evidence:
docs/decisions/report.md."""
_MOVING_PERCENTILE = 75.0
"""Percentile of the displacements of matches that stands for the room."""
_MIN_SHIFT_PX = 6.0
"""Minimum displacement of the room (px of the measured pictures) with which fixed matches differ from it."""
_FIXED_SHARE = 0.2
"""Maximum displacement of a match that is fixed to the camera, as a share of that of the room. Evidence: the
hand beside a wrist camera gave wrong legs in 25 of 38 triples of a path whose rotations agree in 365 of 367
pairs."""
_STEPS = (5, 3, 2, 1)
"""Distances in frames of the pairs across lost frames, in the order in which they are tried. Between near
frames the pictures hardly distinguish a turn from a step to the side, and all errors have the same sign."""
_MIN_WRONG_LINKS = 2
"""Minimum number of wrong rotations across a break, beyond the right ones. The turn across lost frames counts
twice: it is measured through every frame between, and no other measurement spans some gaps."""
_MIN_WRONG_LEGS = 3
"""Minimum number of wrong triples across a break, beyond the right ones. Two triples of neighbouring frames
span each time, so a hand that fills the picture for a moment is no break."""
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
class MeasuredTriple:
    """Three frames with the points that are seen in all of them.

    Attributes:
        common: The points.
        measured: The legs between the frames; None if they are not measurable.
    """

    common: CommonRays
    measured: Legs | None


class Pictures:
    """The features of each frame of a camera, and what has been measured between frames.

    With a rolling shutter, rays are moved to the time of the middle row by the rotation that the pictures
    show between neighbouring frames.
    """

    def __init__(
        self,
        features: Features,
        times_s: FloatArray | None = None,
        readout_s: float = 0.0,
        rotation_chain: RotationChain | None = None,
        *,
        rotations: FloatArray | None = None,
        match: Callable[[FrameFeatures, FrameFeatures], IntArray] = match_features,
    ) -> None:
        """Take the features of all N frames.

        Args:
            features: The features of each frame.
            times_s: (N,) times of the frames; needed only for a rolling shutter.
            readout_s: Time from the exposure of the first row to that of the last row.
            rotation_chain: How the camera turns, by tracks. Only it finds folds across lost frames.
            rotations: (N,3,3) delivered rotations, NaN for a frame without a pose. They correct a rolling
                shutter, and a pair that they fit needs no search, which makes the measurement three times as
                fast. None for measurements that do not depend on the poses.
            match: Returns the rows (M,2) of the features that two frames have in common.
        """
        self.features = features
        self._match, self._rotations = match, rotations
        self.rotation_chain = rotation_chain
        self._times_s = np.arange(float(len(features))) if times_s is None else times_s
        self._readout_s = readout_s
        self._pairs: dict[tuple[int, int], MeasuredPair] = {}
        self._triples: dict[tuple[int, int, int], MeasuredTriple | None] = {}
        self._turn_rad = np.zeros(len(features))
        if times_s is not None and readout_s != 0.0:
            rows = dict[tuple[int, int], IntArray]()
            if rotations is None:
                speed, rows = self._measured_speed(times_s)
            else:
                turns = np.swapaxes(rotations[1:], 1, 2) @ rotations[:-1]
                known = np.flatnonzero(np.isfinite(turns).all(axis=(1, 2)))
                speed = np.full((len(times_s), 2, 3), np.nan)
                turn = so3_log(turns[known]) / np.diff(times_s)[known, None]
                speed[known, 1] = speed[known + 1, 0] = turn
            self._correct_rows(times_s, readout_s, speed)
            self._pairs = {key: self._measured_pair(key, matched) for key, matched in rows.items()}

    def _measured_speed(self, times_s: FloatArray) -> tuple[FloatArray, dict[tuple[int, int], IntArray]]:
        """Return the speed (N,2,3) of the rays, and the matches of each two neighbouring frames."""
        pairs = {(index, index + 1): self.pair(index, index + 1) for index in range(len(times_s) - 1)}
        speed = np.full((len(times_s), 2, 3), np.nan)
        for (first, second), pair in pairs.items():
            if pair.measured is not None:
                turn = so3_log(pair.measured.rotation) / (times_s[second] - times_s[first])
                speed[first, 1] = speed[second, 0] = turn
        return speed, {key: pair.rows for key, pair in pairs.items()}

    def _correct_rows(self, times_s: FloatArray, readout_s: float, speed: FloatArray) -> None:
        """Move the rays to the time of the middle row."""
        frame = np.minimum(np.arange(len(speed)), len(speed) - 2)
        self._turn_rad = abs(readout_s) * np.linalg.norm(speed[frame, 1], axis=1)
        known = np.isfinite(speed)
        mean = np.sum(np.where(known, speed, 0.0), axis=1) / np.maximum(np.sum(known, axis=1), 1)
        interval_s = np.gradient(times_s)[:, None]
        change = np.nan_to_num(speed[:, 1] - speed[:, 0]) / interval_s
        self.features = [
            each and _at_middle_row(each, readout_s * each.row, mean[index], change[index])
            for index, each in enumerate(self.features)
        ]

    def pair(self, first: int, second: int) -> MeasuredPair:
        """Match two frames and measure their relative rotation, once."""
        found = self._pairs.get((first, second))
        if found is None:
            found = self._pairs[first, second] = self._measured_pair((first, second))
        return found

    def _measured_pair(self, frames: tuple[int, int], rows: IntArray | None = None) -> MeasuredPair:
        """Match two frames, if their matches are not given, and measure their relative rotation."""
        first, second = self.features[frames[0]], self.features[frames[1]]
        if first is None or second is None:
            return MeasuredPair(rows=np.zeros((0, 2), dtype=np.int64), measured=None)
        if rows is None:
            rows = _not_fixed_to_camera(first, second, self._match(first, second))
        expected = None
        if self._rotations is not None:
            expected = self._rotations[frames[1]].T @ self._rotations[frames[0]]
        return MeasuredPair(rows=rows, measured=measure_rotation(_ray_matches(first, second, rows), expected))

    def _turns_little(self, frame: int) -> bool:
        """Return True if the camera turns little enough while a frame is read out for an exact correction."""
        return bool(self._turn_rad[frame] < np.deg2rad(_MAX_READOUT_TURN_DEG))

    def triple(self, frames: tuple[int, int, int]) -> MeasuredTriple | None:
        """Measure the legs between three frames, once; None if they have too few points in common."""
        if frames not in self._triples and not all(map(self._turns_little, frames)):
            self._triples[frames] = None
        if frames not in self._triples:
            self._triples[frames] = _measure_triple(
                [self.features[index] for index in frames],
                self.pair(*frames[:2]),
                self.pair(*frames[1:]),
                self._readout_s,
                np.diff(self._times_s[list(frames)]),
            )
        return self._triples[frames]


@dataclass(frozen=True, slots=True, kw_only=True)
class RightFrames:
    """The outcome for one camera.

    Attributes:
        outcome: (N,) outcome of each frame; None for a frame without a pose.
        links: Number of pairs of frames whose rotation was compared, by outcome.
        legs: Outcome of the positions of each three frames that were compared, by the first and last frame.
    """

    outcome: tuple[Outcome | None, ...]
    links: Mapping[Outcome, int]
    legs: Mapping[tuple[int, int], Outcome]

    @property
    def positions(self) -> Mapping[Outcome, int]:
        """Number of triples of frames whose positions were compared, by outcome."""
        return Counter(self.legs.values())

    def count(self, outcome: Outcome) -> int:
        """Return the number of frames with an outcome."""
        return sum(each is outcome for each in self.outcome)


def join_paths(paths: Sequence[RightFrames]) -> RightFrames:
    """Return the outcome for one camera whose frames are in several paths, each in a map of its own.

    Args:
        paths: The outcome of each path. No frame is in two paths.
    """
    outcomes = zip(*(path.outcome for path in paths), strict=True)
    return RightFrames(
        outcome=tuple(next((each for each in frame if each is not None), None) for frame in outcomes),
        links=sum((Counter(path.links) for path in paths), Counter[Outcome]()),
        legs={frames: outcome for path in paths for frames, outcome in path.legs.items()},
    )


def _at_middle_row(
    features: FrameFeatures, after_s: FloatArray, speed: FloatArray, change: FloatArray
) -> FrameFeatures:
    """Move rays to the time of the middle row.

    Args:
        features: The features of one frame.
        after_s: (N,) time of each feature after that of the middle row.
        speed: (3,) rotation of the rays, rad/s.
        change: (3,) its change, rad/s². Half of its effect counts as noise: between frames, it varies itself.
    """
    quadratic = 0.5 * after_s[:, None] ** 2 * change
    turn = so3_exp(-(after_s[:, None] * speed + quadratic))
    return replace(
        features,
        rays=np.einsum("nij,nj->ni", turn, features.rays),
        pixel_rad=np.hypot(features.pixel_rad, 0.5 * np.linalg.norm(quadratic, axis=1)),
    )


def _not_fixed_to_camera(first: FrameFeatures, second: FrameFeatures, rows: IntArray) -> IntArray:
    """Leave out matches (M,2) that stay in the picture while it moves, for example on the own hand."""
    if len(rows) == 0:
        return rows
    moved_px = (
        np.linalg.norm(first.rays[rows[:, 0]] - second.rays[rows[:, 1]], axis=1) / first.pixel_rad[rows[:, 0]]
    )
    room_px = float(np.percentile(moved_px, _MOVING_PERCENTILE))
    return rows if room_px < _MIN_SHIFT_PX else np.asarray(rows[moved_px >= _FIXED_SHARE * room_px])


def _ray_matches(first: FrameFeatures, second: FrameFeatures, rows: IntArray) -> RayMatches:
    return RayMatches(
        first=first.rays[rows[:, 0]],
        second=second.rays[rows[:, 1]],
        cells=first.cells[rows[:, 0]],
        noise_rad=np.maximum(first.pixel_rad[rows[:, 0]], second.pixel_rad[rows[:, 1]]),
    )


def _judge_pair(pictures: Pictures, frames: tuple[int, int], world_from_cam: FloatArray) -> Outcome:
    """Compare the delivered rotation between two frames with their matches, as `judge_rotation` does."""
    pair = pictures.pair(*frames)
    first, second = pictures.features[frames[0]], pictures.features[frames[1]]
    if first is None or second is None:
        return Outcome.UNMEASURABLE
    expected = world_from_cam[frames[1], :3, :3].T @ world_from_cam[frames[0], :3, :3]
    return judge_rotation(_ray_matches(first, second, pair.rows), pair.measured, expected)


def _judge_gap(pictures: Pictures, frames: tuple[int, int], world_from_cam: FloatArray) -> Outcome:
    """Compare the delivered rotation across lost frames with the turn that the video shows.

    A turn that agrees is right even if it is inexact, as in `judge_rotation`: a wrong path would not agree.
    Only the tracks state how exact their turn is, so the pairs of the lost frames contradict nothing.
    """
    limit_rad = np.deg2rad(WRONG_DEG)
    rotations = world_from_cam[list(frames), :3, :3]
    chain = pictures.rotation_chain
    found = None if chain is None else chain.compare(*frames, rotations)
    if found is not None and found.is_wrong(limit_rad):
        return Outcome.WRONG
    agrees = found is not None and found.angle_rad <= limit_rad
    agrees = agrees or _angle_from_pairs(pictures, frames, rotations) <= limit_rad
    return Outcome.RIGHT if agrees else Outcome.UNMEASURABLE


def _angle_from_pairs(pictures: Pictures, frames: tuple[int, int], rotations: FloatArray) -> float:
    """Return the angle between a turn (2,3,3) and that of the pairs between; infinity if they have a gap."""
    turn, index = np.eye(3), frames[0]
    while index < frames[1]:
        steps = (min(index + step, frames[1]) for step in _STEPS)
        tried = ((end, pictures.pair(index, end).measured) for end in steps)
        end, measured = next((pair for pair in tried if pair[1] is not None), (index, None))
        if measured is None:
            return np.inf
        turn, index = measured.rotation @ turn, end
    return float(rotation_angle_rad(rotations[1].T @ rotations[0] @ turn.T))


def find_right_frames(
    pictures: Pictures,
    world_from_cam: FloatArray,
    progress: Callable[[int, int], None] | None = None,
    gaps: Mapping[int, int] = GAPS,
) -> RightFrames:
    """Compare the delivered poses of one camera with its pictures.

    Args:
        pictures: The features of all N frames.
        world_from_cam: (N,4,4) delivered poses; NaN for a frame without one.
        progress: Receives the number of finished frames and of all frames.
        gaps: Distances in frames of the linked frames, and every how many frames a link starts.
    """
    posed = has_pose(world_from_cam)
    count, links_of = len(posed), dict[tuple[int, int], Outcome]()
    for first in range(count):
        if progress is not None:
            progress(first, count)
        for gap, every in gaps.items():
            second = first + gap
            if first % every == 0 and second < count and posed[first] and posed[second]:
                links_of[first, second] = _judge_pair(pictures, (first, second), world_from_cam)
    ends = pairwise(np.flatnonzero(posed).tolist())
    gaps_of = {(a, b): _judge_gap(pictures, (a, b), world_from_cam) for a, b in ends if b - a > 1}
    legs = _position_outcomes(pictures, list(links_of), world_from_cam)
    outcomes = links_of | gaps_of
    outcomes |= _revisits(pictures, world_from_cam, posed)
    spans: dict[Outcome, list[tuple[int, int]]] = defaultdict(list)
    for frames, (outcome, _) in legs.items():
        spans[outcome].append((frames[0], frames[2]))
    links = {each: [pair for pair, found in outcomes.items() if found is each] for each in Outcome}
    twice = {each: [pair for pair in gaps_of if outcomes[pair] is each] for each in Outcome}
    across = {each: links[each] + twice[each] for each in Outcome}
    folds = contradicted_times(across[Outcome.WRONG], across[Outcome.RIGHT], count, _MIN_WRONG_LINKS)
    unexplained = [span for span in spans[Outcome.WRONG] if not _spans(span, folds)]
    leaps = contradicted_times(unexplained, spans[Outcome.RIGHT], count, _MIN_WRONG_LEGS)
    breaks = sorted({*folds, *leaps})
    measured = [(frames, found) for frames, (_, found) in legs.items() if found is not None]
    jumps = scale_jumps(measured, world_from_cam[:, :3, 3], breaks)
    wrong = links[Outcome.WRONG] + spans[Outcome.WRONG] + [(time - 1, time) for time in jumps]
    parts = np.searchsorted(sorted({*breaks, *jumps}), np.arange(count), side="right")
    sets = _joined_parts(parts, links, spans)
    return RightFrames(
        outcome=_frame_outcomes(sets, links[Outcome.RIGHT], wrong, posed),
        links=Counter(outcomes.values()),
        legs={(frames[0], frames[2]): outcome for frames, (outcome, _) in legs.items()},
    )


def _spans(frames: tuple[int, int], times: Sequence[int]) -> bool:
    return any(frames[0] < time <= frames[1] for time in times)


def has_pose(world_from_cam: FloatArray) -> BoolArray:
    """Return a mask (N,) of the poses (N,4,4) that are known: those of lost frames are NaN."""
    return np.asarray(np.isfinite(world_from_cam).all(axis=(1, 2)))


def _position_outcomes(
    pictures: Pictures, pairs: Sequence[tuple[int, int]], world_from_cam: FloatArray
) -> dict[tuple[int, int, int], tuple[Outcome, Legs | None]]:
    """Compare the positions of each three frames at equal distances."""
    found: dict[tuple[int, int, int], tuple[Outcome, Legs | None]] = {}
    linked = set(pairs)
    for first, second in pairs:
        frames = (first, second, 2 * second - first)
        triple = pictures.triple(frames) if frames[1:] in linked else None
        if triple is None:
            continue
        poses = world_from_cam[list(frames)]
        middle_from_world = poses[1, :3, :3].T
        rotations = np.swapaxes(middle_from_world @ poses[[0, 2], :3, :3], 1, 2)
        legs = np.diff(poses[:, :3, 3], axis=0) @ middle_from_world.T
        found[frames] = judge_legs(triple.common, triple.measured, rotations, legs)
    return found


def _measure_triple(
    seen: Sequence[FrameFeatures | None],
    before: MeasuredPair,
    after: MeasuredPair,
    readout_s: float,
    between_s: FloatArray,
) -> MeasuredTriple | None:
    """Measure the legs between three frames from the features of the middle one that both pairs match.

    Args:
        seen: The features of the three frames.
        before: The first and the middle frame.
        after: The middle and the last frame.
        readout_s: Time from the exposure of the first row to that of the last row.
        between_s: (2,) times between the frames.
    """
    if before.measured is None or after.measured is None:
        return None
    middle, one, two = np.intersect1d(before.rows[:, 1], after.rows[:, 0], return_indices=True)
    chosen = (before.rows[one, 0], middle, after.rows[two, 1])
    views = [(each, row) for each, row in zip(seen, chosen, strict=True) if each is not None]
    late = np.stack([each.row[row] for each, row in views]) * readout_s
    # The point was seen in the middle frame, and before and after it, for a time that depends on its rows.
    elapsed = 1.0 + np.stack([(late[1] - late[0]) / between_s[0], (late[2] - late[1]) / between_s[1]])
    common = CommonRays(
        rays=np.stack([each.rays[row] for each, row in views]),
        noise_rad=np.max([each.pixel_rad[row] for each, row in views], axis=0),
        cells=views[1][0].cells[middle],
        elapsed=elapsed,
    )
    return MeasuredTriple(common=common, measured=measure_legs(common, (before.measured, after.measured)))


def _revisits(
    pictures: Pictures, world_from_cam: FloatArray, posed: BoolArray
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
            ends = (first, int(second))
            outcomes[ends] = _judge_pair(pictures, ends, world_from_cam)
    return outcomes


def _joined_parts(
    parts: IntArray,
    links: Mapping[Outcome, Sequence[tuple[int, int]]],
    legs: Mapping[Outcome, Sequence[tuple[int, int]]],
) -> IntArray:
    """Join the parts of a path between its breaks again if right links between them outnumber wrong ones.

    Neighbouring parts stay apart: there is a break between them.

    Args:
        parts: (N,) number of the part of each frame.
        links: First and last frame of each pair, by outcome.
        legs: First and last frame of each triple, by outcome.

    Returns:
        The label (N,) of each frame's set.
    """
    count = int(parts[-1]) + 1
    net = np.zeros((2, count, count), dtype=np.int64)
    for kind, spans in enumerate((links, legs)):
        for outcome, vote in ((Outcome.RIGHT, 1), (Outcome.WRONG, -1)):
            for first, last in spans.get(outcome, ()):
                net[kind, parts[first], parts[last]] += vote
    label = np.arange(count)
    apart = {(part, part + 1) for part in range(count - 1)}
    for first, last in sorted(zip(*np.nonzero(net[0] > 0), strict=True), key=lambda each: -net[0][each]):
        one, two = np.flatnonzero(label == label[first]), np.flatnonzero(label == label[last])
        both = [(min(a, b), max(a, b)) for a in one for b in two]
        sums = [sum(int(net[kind][pair]) for pair in both) for kind in range(2)]
        if label[first] != label[last] and not apart & set(both) and sums[0] > 0 and sums[1] >= 0:
            label[two] = label[first]
    return np.asarray(label[parts])


def _frame_outcomes(
    sets: IntArray, right: Sequence[tuple[int, int]], wrong: Sequence[tuple[int, int]], posed: BoolArray
) -> tuple[Outcome | None, ...]:
    """Return the outcome of each frame.

    The right frames are the largest group that right links join within one set. A frame of another set is
    wrong if a measurement contradicts its group, and a frame without a link is not measurable.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    inside = np.array([pair for pair in right if sets[pair[0]] == sets[pair[1]]], dtype=np.int64).reshape(
        -1, 2
    )
    shape = (len(posed), len(posed))
    graph = coo_matrix((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=shape)
    groups = connected_components(graph, directed=False)[1]
    sizes = np.bincount(groups[posed], minlength=1 + int(groups.max(initial=0)))
    largest = int(np.argmax(sizes)) if posed.any() else -1
    own_set = sets[groups == largest][0] if posed.any() else -1
    contradicted = {groups[frame] for pair in wrong for frame in pair}
    out: list[Outcome | None] = []
    for frame, is_posed in enumerate(posed):
        if not is_posed:
            out.append(None)
        elif groups[frame] == largest and sizes[largest] > 1:
            out.append(Outcome.RIGHT)
        else:
            is_wrong = sets[frame] != own_set and groups[frame] in contradicted
            out.append(Outcome.WRONG if is_wrong else Outcome.UNMEASURABLE)
    return tuple(out)
