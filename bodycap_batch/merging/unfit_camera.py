"""Solve the body without a camera that fits no person together with the other cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from bodycap_batch.core.errors import EstimationError, ImplausibleBody
from bodycap_batch.model.merge_data import MergeResult

_MAX_JOINT_ERROR = 3.0
"""Maximum remaining error of the joints for each tick, if the remaining cameras fit a person: half the sum of
the squared residuals of the joints, each divided by its sigma. Evidence: docs/decisions/merging.md."""

_UNFIT_REASON = (
    "together with the other cameras, its positions are not possible for a person: a part of its map is "
    "probably wrong"
)


class _Attempt(NamedTuple):
    """A body that was solved without one camera.

    Attributes:
        joint_error: Remaining error of the joints for each tick: half the sum of the squared residuals of the
            joints, each divided by its sigma.
        left_out: Name of the camera that was left out.
        result: The solved body.
    """

    joint_error: float
    left_out: str
    result: MergeResult


def merge_without_unfit_camera(
    cameras: Sequence[str], solve: Callable[[Mapping[str, str]], MergeResult]
) -> MergeResult:
    """Solve the body. If the cameras fit no person, leave out the one camera that does not fit.

    Each camera is left out in turn. The body that fits the remaining cameras best is used. Two cameras fit a
    body of any size, but at a wrong size the joints bend in ways that are impossible or rare.

    Args:
        cameras: Names of all cameras.
        solve: Function that solves the body without some cameras. Its argument gives the reason why a camera
            is not used, by camera name.

    Returns:
        The solved body. The camera that was left out is among its unused cameras.

    Raises:
        ImplausibleBody: No camera can be left out such that the others fit a person.
        EstimationError: The data do not determine the motion.
    """
    try:
        return solve({})
    except ImplausibleBody:
        attempts = _solve_without_each(cameras, solve)
        if not attempts:
            raise
        return min(attempts, key=lambda attempt: attempt[:2]).result


def _solve_without_each(
    cameras: Sequence[str], solve: Callable[[Mapping[str, str]], MergeResult]
) -> list[_Attempt]:
    """Leave out each camera in turn, and return the bodies that fit."""
    attempts = []
    for camera in cameras:
        try:
            result = solve({camera: _UNFIT_REASON})
        except EstimationError:
            continue
        if camera in result.unused_cameras:
            solver = result.report.solver
            error = solver.half_squared_error["joints"] / max(1, solver.ticks)
            if error <= _MAX_JOINT_ERROR:
                attempts.append(_Attempt(error, camera, result))
    return attempts
