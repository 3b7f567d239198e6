"""Compare a relative rotation that fresh matches show with delivered poses."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.tracks.relative_motion import Motion, RayMatches, refine_motion, usable

WRONG_DEG = 5.0
"""Angle (degrees) beyond which a relative rotation, or the direction to a point, is wrong."""
SIGMAS = 3.0
"""Number of standard deviations of the measurement beyond which a difference is wrong."""
_EQUAL_SUPPORT = 0.8
"""Minimum support of the delivered rotation, relative to the best rotation, with which the pictures do
not decide between both. Two planar solutions of one wall, for instance, have nearly equal support."""
_NOT_EXCLUDED = 0.4
"""Minimum support of the delivered rotation, relative to the best rotation, with which the pictures do not
exclude it: they show two motions, or a wall whose matches determine the rotation badly. Two frames cannot
decide then."""


class Outcome(StrEnum):
    """What fresh matches say of a relation between delivered poses."""

    RIGHT = "right"
    WRONG = "wrong"
    UNMEASURABLE = "not measurable"


def judge_rotation(matches: RayMatches, measured: Motion | None, expected: FloatArray) -> Outcome:
    """Compare a measured rotation with a delivered one.

    A measurement is right by itself if it agrees: matches that follow another motion would not do so. It is
    wrong only if the pictures exclude the delivered rotation, and if most matches follow another one: the
    two solutions of one wall have nearly equal support, and a hand has the support of some matches.

    Args:
        matches: Fresh matches of the two frames.
        measured: The rotation that `measure_rotation` found in them.
        expected: (3,3) delivered rotation second_from_first.
    """
    if measured is None:
        return Outcome.UNMEASURABLE
    if not differs(measured.rotation, measured.rotation_covariance, expected):
        return Outcome.RIGHT
    if 2 * np.count_nonzero(measured.inliers) <= len(matches.first):
        return Outcome.UNMEASURABLE
    nearest = usable(refine_motion(matches, expected))
    is_near = nearest is not None and not differs(nearest.rotation, nearest.rotation_covariance, expected)
    if nearest is not None and is_near and nearest.support >= _EQUAL_SUPPORT * measured.support:
        return Outcome.UNMEASURABLE
    unchanged = refine_motion(matches, expected, turn=False)
    is_possible = unchanged.support >= _NOT_EXCLUDED * measured.support
    return Outcome.UNMEASURABLE if is_possible else Outcome.WRONG


def differs(measured: FloatArray, covariance: FloatArray, expected: FloatArray) -> bool:
    """Return True if a rotation is beyond 5 degrees and 3 sigma of a measured rotation."""
    difference = so3_log(expected @ measured.T)
    if np.linalg.norm(difference) <= np.deg2rad(WRONG_DEG):
        return False
    return bool(difference @ np.linalg.solve(covariance, difference) > SIGMAS**2)
