"""Find pairs of keyframes that only look alike: the rotation of the videos contradicts their matches.

Rooms repeat themselves: bays, windows, cabinets. Pairs that only look alike come in crowds, and they agree
with each other, so neither their number nor their cycles show them. The video does: between two of its
frames, the camera turns by a known angle. The rotations of all keyframes are estimated from those of the
videos and from those of all pairs together, and pairs that do not fit are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import Pair
from bodycap_batch.mapping.matching.near_pairs import are_near
from bodycap_batch.model.geometry import nearest_rotation, so3_exp, so3_log
from bodycap_batch.model.rotation_chain import MIN_ANGLE_RAD

_FIT_ERRORS_RAD = np.deg2rad((40.0, 35.0, 30.0, 25.0, 25.0))
"""Maximum angle between the rotation of a pair and that of its keyframes, so that the pair is used, in each
step of the estimation: at first, the rotations of the videos have drifted. Evidence: none."""
_PAIR_SIGMA_RAD = np.deg2rad(5.0)
"""Standard deviation of the rotation of a pair. Evidence: docs/decisions/mapping.md."""
_LINK_SIGMA_RAD = np.deg2rad(0.5)
"""Standard deviation that is added to each rotation of a video. Evidence: docs/decisions/mapping.md."""
_SAME_RAD, _OTHER_RAD = np.deg2rad(20.0), np.deg2rad(35.0)
"""Maximum angle between rotations that support each other, and minimum angle between rotations that exclude
each other. Evidence: docs/decisions/mapping.md."""
_MIN_RATIO = 1.2
"""Minimum ratio of the number of pairs that support the best rotation to those of another one. Evidence:
docs/decisions/mapping.md."""
_MAX_VOTES = 1000
"""Maximum number of pairs whose rotations are compared with each other. It bounds the time."""


@dataclass(frozen=True, slots=True)
class PairRotation:
    """The rotation between the keyframes of a pair, from its matches.

    Attributes:
        pair: The keyframes.
        rotation: (3,3) rotation second_from_first.
    """

    pair: Pair
    rotation: FloatArray


def find_contradicted_pairs(
    pairs: Sequence[PairRotation], cameras: Mapping[str, CameraIntrinsics]
) -> set[Pair]:
    """Return the pairs whose rotation contradicts that of the videos and of the other pairs.

    Keyframes between which the video shows the rotation make a segment. The segments are joined by the
    rotation that most pairs between them support: first by pairs of one camera that are near in time. If two
    different rotations have about the same support, nothing shows which pairs are right: the segments stay
    apart, and the pairs between them are contradicted.

    Args:
        pairs: The verified pairs. Those with a camera whose rotation is unknown are not judged.
        cameras: What is known of each camera, by name.

    Source: Hartley et al., "Rotation averaging", IJCV 2013, for the problem; Yang et al., "Graduated
        non-convexity for robust spatial perception", RA-L 2020, for the steps of the limit.
    """
    known = {name for name, camera in cameras.items() if camera.rotation_chain is not None}
    judged = [item for item in pairs if known.issuperset((item.pair[0].camera, item.pair[1].camera))]
    if not judged:
        return set()
    graph = _Graph(judged, cameras)
    graph.join_segments(graph.near)
    graph.join_segments(np.ones(len(judged), dtype=bool))
    graph.adjust()
    return {item.pair for item, wrong in zip(judged, graph.contradicted(), strict=True) if wrong}


class _Graph:
    """Rotations of keyframes, with those of videos and pairs between them.

    Attributes:
        near: (P,) True for the pairs of one camera whose keyframes are near in time.
    """

    def __init__(self, pairs: Sequence[PairRotation], cameras: Mapping[str, CameraIntrinsics]) -> None:
        refs = sorted({ref for item in pairs for ref in item.pair})
        row = {ref: number for number, ref in enumerate(refs)}
        self._first = np.array([row[item.pair[0]] for item in pairs])
        self._second = np.array([row[item.pair[1]] for item in pairs])
        self._rotation = np.array([item.rotation for item in pairs])
        times_ns = {name: item.times_ns for name, item in cameras.items() if item.times_ns is not None}
        self.near: BoolArray = np.array([are_near(*item.pair, times_ns) for item in pairs])
        self._world_from_cam = np.tile(np.eye(3), (len(refs), 1, 1))
        self._segment = np.arange(len(refs))
        links = list[tuple[int, int, FloatArray, float]]()
        for last in range(1, len(refs)):
            before, ref = refs[last - 1], refs[last]
            chain = cameras[ref.camera].rotation_chain
            found = None if chain is None else chain.between(before.frame, ref.frame)
            if before.camera == ref.camera and found is not None:
                links.append((last - 1, last, *found))
                self._world_from_cam[last] = self._world_from_cam[last - 1] @ found[0].T
                self._segment[last] = self._segment[last - 1]
        self._links = (
            np.array([link[0] for link in links], dtype=np.int64),
            np.array([link[1] for link in links], dtype=np.int64),
            np.array([link[2] for link in links]).reshape(-1, 3, 3),
            np.array([link[3] for link in links]),
        )

    def join_segments(self, used: BoolArray) -> None:
        """Turn all segments into one frame, the best supported ones first. Undecided ones stay apart.

        Args:
            used: (P,) True for the pairs that are used.
        """
        votes = dict[tuple[int, int], tuple[int, FloatArray] | None]()
        while True:
            between = self._pairs_between(used)
            for key in between.keys() - votes.keys():
                votes[key] = self._vote(key[0], between[key])
            decided = {key: vote for key in between if (vote := votes[key]) is not None}
            if not decided:
                return
            kept, turned = max(sorted(decided), key=lambda key: decided[key][0])
            own = self._segment == turned
            self._world_from_cam[own] = decided[kept, turned][1] @ self._world_from_cam[own]
            self._segment[own] = kept
            votes = {key: vote for key, vote in votes.items() if not {kept, turned} & set(key)}

    def _pairs_between(self, used: BoolArray) -> dict[tuple[int, int], IntArray]:
        """Return the rows of the used pairs between each two segments."""
        segments = np.sort(self._segment[np.stack([self._first, self._second], axis=1)], axis=1)
        rows = np.flatnonzero(used & (segments[:, 0] != segments[:, 1]))
        if not len(rows):
            return {}
        keys, inverse = np.unique(segments[rows], axis=0, return_inverse=True)
        order = np.argsort(inverse.ravel(), kind="stable")
        groups = np.split(rows[order], np.cumsum(np.bincount(inverse.ravel(), minlength=len(keys)))[:-1])
        return {(int(one), int(other)): group for (one, other), group in zip(keys, groups, strict=True)}

    def _vote(self, kept: int, rows: IntArray) -> tuple[int, FloatArray] | None:
        """Return the rotation that turns a segment into another one, and its support; None if undecided.

        The support is the number of pairs that agree, minus that of the next best rotation.

        Args:
            kept: The segment that is not turned.
            rows: The pairs between both.
        """
        turn = self._turns(kept, rows[evenly_spaced(len(rows), _MAX_VOTES)])
        flat = turn.reshape(-1, 9)
        cosine = 0.5 * (flat @ flat.T - 1.0)
        same = cosine > np.cos(_SAME_RAD)
        best = int(np.argmax(same.sum(axis=1)))
        other = cosine[best] < np.cos(_OTHER_RAD)
        support, next_best = int(same[best].sum()), int(same[other][:, other].sum(axis=1).max(initial=0))
        if support < _MIN_RATIO * next_best:
            return None
        return support - next_best, nearest_rotation(turn[same[best]].sum(axis=0))

    def _turns(self, kept: int, rows: IntArray) -> FloatArray:
        """Return, for each of some pairs between two segments, the rotation that turns one into the other.

        Args:
            kept: The segment that is not turned.
            rows: The pairs between both.
        """
        is_kept = self._segment[self._first[rows]] == kept
        inside = np.where(is_kept, self._first[rows], self._second[rows])
        outside = np.where(is_kept, self._second[rows], self._first[rows])
        outside_from_inside = np.where(
            is_kept[:, None, None], self._rotation[rows], np.swapaxes(self._rotation[rows], 1, 2)
        )
        found = self._world_from_cam[inside] @ np.swapaxes(outside_from_inside, 1, 2)
        return np.asarray(found @ np.swapaxes(self._world_from_cam[outside], 1, 2))

    def adjust(self) -> None:
        """Adjust the rotations of all keyframes to those of the videos and of the pairs that fit."""
        from scipy import sparse
        from scipy.sparse.linalg import spsolve

        first, second, rotation, sigma = self._links
        link_weight = 1.0 / (sigma**2 + _LINK_SIGMA_RAD**2)
        size = len(self._world_from_cam)
        for limit in _FIT_ERRORS_RAD:
            error = self._errors(self._first, self._second, self._rotation)
            fits = self._same_segment() & (np.linalg.norm(error, axis=1) < limit)
            start = np.concatenate([self._first[fits], first])
            end = np.concatenate([self._second[fits], second])
            error = np.concatenate([error[fits], self._errors(first, second, rotation)])
            weight = np.concatenate([np.full(fits.sum(), _PAIR_SIGMA_RAD**-2), link_weight])
            pull = weight[:, None] * np.einsum("eij,ej->ei", self._world_from_cam[end], error)
            right = np.zeros((size, 3))
            np.add.at(right, start, -pull)
            np.add.at(right, end, pull)
            entries = np.concatenate([weight, weight, -weight, -weight])
            rows, columns = np.concatenate([start, end, start, end]), np.concatenate([start, end, end, start])
            matrix = sparse.coo_matrix((entries, (rows, columns)), (size, size)).tocsc()
            # The gauge of each segment is free.
            turn = spsolve(matrix + 1e-6 * sparse.eye(size, format="csc"), right)
            self._world_from_cam = so3_exp(np.asarray(turn).reshape(-1, 3)) @ self._world_from_cam

    def contradicted(self) -> BoolArray:
        """Return a mask (P,) of the pairs that do not fit."""
        error = np.linalg.norm(self._errors(self._first, self._second, self._rotation), axis=1)
        return np.asarray(~self._same_segment() | (error > MIN_ANGLE_RAD))

    def _same_segment(self) -> BoolArray:
        return np.asarray(self._segment[self._first] == self._segment[self._second])

    def _errors(self, first: IntArray, second: IntArray, rotation: FloatArray) -> FloatArray:
        """Return the rotation vectors (E,3) from rotations second_from_first to those of the keyframes."""
        found = np.swapaxes(self._world_from_cam[second], 1, 2) @ self._world_from_cam[first]
        return so3_log(found @ np.swapaxes(rotation, 1, 2))
