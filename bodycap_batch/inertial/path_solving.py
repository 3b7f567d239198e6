"""Solve the poses of a clip again, from the poses of its pictures and the samples of its inertial sensor.

The errors of poses that rest on few points last for several frames and are much larger than those of the
motion that a sensor measures over half a second. Windows that overlap are solved, and the middle of each
is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.inertial.clip_solver import MAX_FIX_SIGMAS, ClipSolver
from bodycap_batch.inertial.gap_solver import SolvedStretch
from bodycap_batch.model.scene import Trajectory

_WINDOW_S, _CORE_S = 1.6, 0.4
"""Length (seconds) of a window, and of its middle part that is used. Errors of poses at a distance of half a
second have little effect. Evidence: none."""
_MIN_FIXES = 8
"""Minimum number of localised frames of a window. Evidence: none."""
_MAX_MEDIAN_SIGMAS, _MAX_WRONG_RATIO = 4.0, 0.25
"""Maximum median of the residuals of a window's poses, in sigmas of six axes, and maximum share of wrong
ones. Beyond them the sensor does not describe the motion. The median of six independent axes is 2.3.
Evidence: docs/decisions/telemetry.md."""
_MAX_CONSTANT_SIGMAS = 6.0
"""Maximum change of a constant of the sensor in a window, in sigmas of its estimate from the whole clip.
Evidence: docs/decisions/telemetry.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedPath:
    """The poses of a clip after they were solved together with the sensor.

    Attributes:
        trajectory: The trajectory. Statuses and covariances are unchanged.
        moved: (N,) True for frames whose pose was solved again.
        wrong: (N,) True for localised frames whose own pose contradicts the sensor and the other poses. They
            keep this pose.
    """

    trajectory: Trajectory
    moved: BoolArray
    wrong: BoolArray


def solve_path(solver: ClipSolver) -> SolvedPath:
    """Solve the localised frames of a clip again.

    A window is used if its poses agree with the sensor, except a few wrong ones. Errors that all poses of a
    window have in common are not seen, so the covariances stay those of the pictures. Where most poses of a
    window contradict the sensor by more than these covariances, they are enlarged until the poses agree.

    Args:
        solver: The poses and the samples of the clip.
    """
    path, times_s, known = solver.trajectory, solver.times_s, solver.known
    poses, covariance = path.gauge_from_cam.copy(), path.covariance.copy()
    moved, wrong = np.zeros(len(times_s), dtype=bool), np.zeros(len(times_s), dtype=bool)
    frames = np.flatnonzero(known)
    usable = frames[
        (times_s[frames] >= solver.samples.times_s[0]) & (times_s[frames] <= solver.samples.times_s[-1])
    ]
    if not len(usable):
        return SolvedPath(trajectory=path, moved=moved, wrong=wrong)
    start_s = float(times_s[usable[0]])
    window = np.round((times_s[usable] - start_s) / _CORE_S).astype(np.int64)
    for number in np.unique(window).tolist():
        core = usable[window == number]
        inside = usable[np.abs(times_s[usable] - start_s - number * _CORE_S) <= 0.5 * _WINDOW_S]
        if len(inside) < _MIN_FIXES:
            continue
        start, end = int(inside[0]), int(inside[-1]) + 1
        used = np.isin(np.arange(len(times_s)), inside)
        if (np.diff(times_s[start:end]) <= 0.0).any():
            continue
        found = solver.solve_grown(start, end, used)
        if found is None or not _describes_motion(found[0], solver):
            continue
        solved, growth = found
        sigmas = solved.fix_sigmas[np.searchsorted(inside, core)]
        right = core[sigmas <= MAX_FIX_SIGMAS]
        poses[right] = solved.gauge_from_cam[right - start]
        covariance[right] *= growth
        moved[right] = True
        wrong[core] = sigmas > MAX_FIX_SIGMAS
    solved_path = replace(path, gauge_from_cam=poses, covariance=covariance)
    return SolvedPath(trajectory=solved_path, moved=moved, wrong=wrong)


def _describes_motion(solved: SolvedStretch, solver: ClipSolver) -> bool:
    """Return True if poses and sensor of a window agree, except a few wrong poses."""
    if np.median(solved.fix_sigmas) > _MAX_MEDIAN_SIGMAS:
        return False
    if np.mean(solved.fix_sigmas > MAX_FIX_SIGMAS) > _MAX_WRONG_RATIO:
        return False
    change = solved.constants - solver.constants.mean
    sigma = np.sqrt(np.diag(solver.constants.covariance))
    return bool(np.abs(change / sigma).max() <= _MAX_CONSTANT_SIGMAS)
