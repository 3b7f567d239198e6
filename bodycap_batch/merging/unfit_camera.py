"""Solve the body without a camera that fits no person together with the other cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from bodycap_batch.core.errors import EstimationError, ImplausibleBody
from bodycap_batch.model.merge_data import MergeResult

_MAX_JOINT_ERROR = 3.0
"""Maximum remaining error of the joints for each tick, if the remaining cameras fit a person: half the sum of
the squared residuals of the joints, each divided by its sigma. Evidence: docs/decisions/merging.md."""

_UNFIT_REASON = (
    "together with the other cameras, its positions are not possible for a person: a part of its map is "
    "probably wrong"
)


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
        fitting: list[tuple[float, str, MergeResult]] = []
        for camera in cameras:
            try:
                result = solve({camera: _UNFIT_REASON})
            except EstimationError:
                continue
            solver = result.report.solver
            joint_error = solver.half_squared_error["joints"] / max(1, solver.ticks)
            if camera in result.unused_cameras and joint_error <= _MAX_JOINT_ERROR:
                fitting.append((joint_error, camera, result))
        if not fitting:
            raise
        return min(fitting, key=lambda each: each[:2])[2]
