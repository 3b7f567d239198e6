"""Estimate readout times before the map exists, from matches between adjacent frames.

A wrong readout time leaves deviations between matches and rotation wherever the camera turns at different
speeds in two adjacent frames. If the camera turns at a constant speed, nothing shows the readout time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import Capture, CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    groups_of_equal_cameras,
    judged_readout,
)
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_fit import MatchedRays, fit_to_rays
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import KeyframeSelection

_STEP_S = 0.003
"""Distance of the readout times at which the cost is computed, seconds. Evidence: none."""
_LAST_STEP_S = 0.001
"""Distance of the readout times in the last search, seconds. Evidence: none."""
_MAX_READOUT_S = 0.033
"""Maximum readout time that is searched, seconds. Origin: sensors of phones and action cameras need 8 to 33
ms."""
_GRID_S = 0.0005
"""Distance of the centres of parabolas in the last search, seconds. Cameras share them, so that costs are
computed once. The minimum of a parabola is not on the grid. Evidence: docs/decisions/mapping.md."""
_MAX_SEARCHES = 4
"""Maximum number of parabolas in the last search. Evidence: none."""
_SCALE_PX = 1.5
"""Scale of the robust cost of a deviation, px of an image with a long side of 640 px. Evidence: none."""
_UNKNOWN_COST = 5.0
"""Cost of a match of a pair whose rotation is unknown. Origin: the cost of a deviation of twelve times the
scale."""
_MAX_FRAMES = 300
"""Maximum number of successive frames of a camera that are used. The frames in which the speed of the picture
changes most are taken. It bounds the time for long videos. Evidence: none."""
_BLOCK_FRAMES = 15
"""Number of successive frames in a block: half a second. Blocks are the independent samples from which the
standard deviation is estimated. Evidence: none."""
_MIN_BLOCKS = 4
"""Minimum number of blocks for a standard deviation. Evidence: none."""
_MAX_SIGMAS = 3.0
"""Maximum deviation of the readout time of a camera from that of equal cameras, in its standard deviations.
Evidence: none."""
_MAX_SIGMA_S = 0.004
"""Maximum standard deviation (seconds) of the readout time of a camera that is compared with that of equal
cameras. Evidence: none."""
_FLOOR_SIGMA_S = 0.0002
"""Standard deviation that is added to each estimate, seconds, because the model has no translation. Evidence:
none."""
_MODEL_SIGMA_RATIO = 0.025
"""Standard deviation that is added to each estimate, as a ratio of the readout time. A hand shakes faster
than the spline through the orientations of the frames follows. Evidence: docs/decisions/mapping.md."""
_PARALLAX_COST_RATIO = 0.0016
"""Change of the cost, as a ratio of the least cost, at one standard deviation of the readout time. What
remains of the deviations is mostly parallax, and a small part of it looks like a rolling shutter. Evidence:
docs/decisions/mapping.md."""


@dataclass(slots=True)
class _Profile:
    """The cost of the matches of one camera as a function of the readout time.

    Attributes:
        rays: The matches.
        times_ns: (N,) frame times, nanoseconds.
        scale_rad: Scale of the robust cost, radians.
        costs: Cost (N-1,) of each pair of frames, by readout time in microseconds.
        paths: The rotation of the camera, by readout time in microseconds.
    """

    rays: MatchedRays
    times_ns: IntArray
    scale_rad: float
    costs: dict[int, FloatArray] = field(default_factory=dict)
    paths: dict[int, RotationPath] = field(default_factory=dict)

    @staticmethod
    def create(selection: KeyframeSelection, camera: CaptureCamera, *, sideways: bool) -> _Profile | None:
        """Return the profile of a camera; None if it has no matches."""
        if selection.matches is None or len(selection.matches.frame) == 0:
            return None
        lens = replace(camera.camera, sideways=sideways)
        first, stop = _liveliest_frames(selection.matches, len(camera.times_ns))
        inside = (selection.matches.frame >= first) & (selection.matches.frame < stop - 1)
        matches = replace(
            selection.matches,
            frame=selection.matches.frame[inside] - first,
            first_px=selection.matches.first_px[inside],
            second_px=selection.matches.second_px[inside],
        )
        scale_px = _SCALE_PX * pixel_scale(lens.width_px, lens.height_px)
        rays = MatchedRays.of(matches, lens, stop - first)
        return _Profile(rays, camera.times_ns[first:stop], scale_px / lens.focal_px)

    def pair_costs(self, readout_s: float) -> FloatArray:
        """Return the cost (N-1,) of each pair of frames at a readout time."""
        key = round(readout_s * 1e6)
        if key not in self.costs:
            near = min(self.paths, key=lambda other: abs(other - key)) if self.paths else None
            start = None if near is None else self.paths[near]
            path = fit_to_rays(self.rays, self.times_ns, key * 1e-6, start, with_rates=False)
            first, second = self.rays.at_mid_row(path, key * 1e-6)
            step, known = path.steps()
            deviation = np.linalg.norm(second - first @ np.swapaxes(step, 1, 2), axis=2)
            each = np.where(known[:, None], np.log1p((deviation / self.scale_rad) ** 2), _UNKNOWN_COST)
            self.costs[key], self.paths[key] = (each * self.rays.used).sum(axis=1), path
        return self.costs[key]

    def speeds(self) -> FloatArray:
        """Return the mean shift (N-1,) of the rays of each pair, radians."""
        shift = np.linalg.norm(self.rays.second - self.rays.first, axis=2) * self.rays.used
        return np.asarray(shift.sum(axis=1) / np.maximum(self.rays.used.sum(axis=1), 1))


def _liveliest_frames(matches: FrameMatches, count: int) -> tuple[int, int]:
    """Return the range of up to `_MAX_FRAMES` frames in which the speed of the picture changes most."""
    if count <= _MAX_FRAMES:
        return 0, count
    shift = (matches.second_px - matches.first_px).astype(np.float64)
    total = np.stack([np.bincount(matches.frame, weights=each, minlength=count) for each in shift.T])
    mean = total / np.maximum(np.bincount(matches.frame, minlength=count), 1)
    change = np.concatenate([[0.0], np.linalg.norm(np.diff(mean, axis=1), axis=0)])
    # A cut or a wrong match is no reason to take a part of the video.
    summed = np.concatenate([[0.0], np.cumsum(np.minimum(change, np.percentile(change, 95.0)))])
    first = int(np.argmax(summed[_MAX_FRAMES:] - summed[:-_MAX_FRAMES]))
    return first, first + _MAX_FRAMES


@dataclass(frozen=True, slots=True)
class _Estimate:
    """The readout time with the least cost.

    Attributes:
        seconds: The readout time.
        sigma_s: Its standard deviation; infinity if it is not determined.
        cost: The least cost.
    """

    seconds: float
    sigma_s: float
    cost: float


def estimate_from_matches(capture: Capture, selections: Sequence[KeyframeSelection]) -> dict[str, Readout]:
    """Estimate the readout times that are not given in the job, by camera name.

    All putative matches are used. Matches that contradict the rotation have a limited cost, so the cost is
    computed with corrected deviations at each readout time, and no match is lost for another readout time.
    Cameras with equal intrinsics and frame rates share one readout time if their data allow it.

    Args:
        capture: All cameras.
        selections: The keyframes of the cameras, with the matches between adjacent frames.

    Source: Ringaby, Forssén, "Efficient video rectification and stabilisation for cell-phones", IJCV 2012,
        for the readout time from the rotation of the camera.
    """
    if not is_on(Mechanism.READOUT_PROFILE):
        return {}
    profiles: dict[str, _Profile] = {}
    sideways: dict[str, bool] = {}
    for selection in selections:
        camera = capture.camera(selection.camera)
        if camera.rolling_shutter_known:
            continue
        found = _best_direction(selection, camera)
        if found is not None:
            sideways[camera.name], profiles[camera.name] = found
    out: dict[str, Readout] = {}
    for names in groups_of_equal_cameras(capture.camera(name) for name in profiles):
        single = {name: _estimate([profiles[name]]) for name in names}
        joint = _estimate([profiles[name] for name in names]) if len(names) > 1 else None
        if joint is not None and not _agree(list(single.values()), joint):
            joint = None
        for name in names:
            estimate = joint or single[name]
            out[name] = judged_readout(estimate.seconds, estimate.sigma_s, sideways=sideways[name])
    return out


def _best_direction(selection: KeyframeSelection, camera: CaptureCamera) -> tuple[bool, _Profile] | None:
    """Return whether the rows of the sensor are columns of the image, and the profile in this direction."""
    directions = (False, True) if camera.may_be_sideways else (camera.camera.sideways,)
    found = [
        (direction, profile)
        for direction in directions
        if (profile := _Profile.create(selection, camera, sideways=direction)) is not None
    ]
    if len(found) < 2:
        return found[0] if found else None
    return min(found, key=lambda item: _estimate([item[1]]).cost)


def _agree(single: Sequence[_Estimate], joint: _Estimate) -> bool:
    """Return whether the readout times of single cameras agree with the common readout time.

    Cameras whose data determine no readout time are not asked.
    """
    determined = [each for each in single if each.sigma_s <= _MAX_SIGMA_S]
    return all(abs(each.seconds - joint.seconds) <= _MAX_SIGMAS * each.sigma_s for each in determined)


def _estimate(profiles: Sequence[_Profile]) -> _Estimate:
    """Return the readout time with the least cost of all matches of some cameras."""
    limit_s = min(_MAX_READOUT_S, *(float(np.median(np.diff(item.times_ns))) * 1e-9 for item in profiles))

    def cost(readout_s: float) -> float:
        return float(sum(item.pair_costs(readout_s).sum() for item in profiles))

    centre = _bracketed_minimum(cost, limit_s)
    step_s, best = _STEP_S, centre
    for _ in range(_MAX_SEARCHES):
        grid = [centre - step_s, centre, centre + step_s]
        best = centre + step_s * _parabola_minimum(np.array([cost(value) for value in grid]))
        nearest = round(_GRID_S * round(best / _GRID_S), 6)
        if nearest == centre and step_s == _LAST_STEP_S:
            break
        centre, step_s = nearest, _LAST_STEP_S
    sigma_s = _sigma_s(profiles, centre, best, step_s)
    if sigma_s > _MAX_SIGMA_S:
        # The cost is rough where rotations of pairs are uncertain. Then a wider parabola determines more.
        wide = np.array([cost(centre + step * _STEP_S) for step in (-1, 0, 1)])
        wide_best = centre + _STEP_S * _parabola_minimum(wide)
        wide_sigma_s = _sigma_s(profiles, centre, wide_best, _STEP_S)
        if wide_sigma_s < sigma_s:
            best, sigma_s = wide_best, wide_sigma_s
    return _Estimate(best, sigma_s if abs(best) <= limit_s else float("inf"), cost(centre))


def _sigma_s(profiles: Sequence[_Profile], centre_s: float, best_s: float, step_s: float) -> float:
    """Return the standard deviation (seconds) of a readout time from a parabola; infinity if it is unknown.

    Args:
        profiles: The cameras.
        centre_s: Readout time in the middle of the parabola, seconds.
        best_s: Readout time with the least cost, seconds.
        step_s: Distance of the readout times of the parabola, seconds.
    """
    grid = [centre_s - step_s, centre_s, centre_s + step_s]
    costs = [np.stack([item.pair_costs(value) for value in grid]) for item in profiles]
    sigma_s = _standard_deviation(costs, [item.speeds() for item in profiles], step_s)
    return float(np.hypot(sigma_s, _MODEL_SIGMA_RATIO * best_s))


def _bracketed_minimum(cost: Callable[[float], float], limit_s: float) -> float:
    """Return the readout time on a coarse grid with the least cost.

    From 0, the search goes on in the direction in which the cost falls, until it has risen twice.
    """
    best, least = 0.0, cost(0.0)
    direction = 1.0 if cost(_STEP_S) <= cost(-_STEP_S) else -1.0
    value, rises = direction * _STEP_S, 0
    while abs(value) <= limit_s and rises < 2:
        current = cost(value)
        rises = 0 if current < least else rises + 1
        if current < least:
            best, least = value, current
        value += direction * _STEP_S
    return best


def _parabola_minimum(costs: FloatArray) -> float:
    """Return the place of the minimum of a parabola through costs (3,) at −1, 0 and 1, between −2 and 2."""
    bend = costs[0] - 2.0 * costs[1] + costs[2]
    if bend <= 0.0:
        return float(np.sign(costs[0] - costs[2]))
    return float(np.clip(0.5 * (costs[0] - costs[2]) / bend, -2.0, 2.0))


def _standard_deviation(costs: Sequence[FloatArray], speeds: Sequence[FloatArray], step_s: float) -> float:
    """Return the standard deviation of a readout time, seconds; infinity if it is not determined.

    It has a part from the scatter of the data, and a part from the parallax, which the model does not have.
    Blocks of successive frames are left out one after another (jackknife). The slower and the faster half of
    the pairs must agree, too: otherwise their difference is the standard deviation.

    Args:
        costs: (3,P) cost of each pair of frames of each camera, at −1, 0 and 1 steps.
        speeds: (P,) speed of the picture in each pair of frames of each camera.
        step_s: The step, seconds.
    """
    total = np.sum([each.sum(axis=1) for each in costs], axis=0)
    blocks = [
        each[:, start : start + _BLOCK_FRAMES].sum(axis=1)
        for each in costs
        for start in range(0, each.shape[1], _BLOCK_FRAMES)
    ]
    if len(blocks) < _MIN_BLOCKS or total[0] - 2.0 * total[1] + total[2] <= 0.0:
        return float("inf")
    without = np.array([_newton_step(total - block) for block in blocks])
    few = _few_blocks_factor(len(blocks))
    variance = few**2 * (len(blocks) - 1) / len(blocks) * ((without - without.mean()) ** 2).sum()
    variance += 2.0 * _PARALLAX_COST_RATIO * total[1] / (total[0] - 2.0 * total[1] + total[2])
    every, speed = np.concatenate(list(costs), axis=1), np.concatenate(list(speeds))
    fast: BoolArray = np.asarray(speed > np.median(speed))
    halves = [_half(every[:, part]) for part in (fast, ~fast)]
    sigma = float(np.sqrt(variance))
    difference = abs(halves[0][0] - halves[1][0])
    if difference > 2.0 * np.hypot(halves[0][1], halves[1][1]):
        sigma = max(sigma, min(difference, 2.0 * sigma))
    return float(np.hypot(step_s * sigma, _FLOOR_SIGMA_S))


def _newton_step(costs: FloatArray) -> float:
    """Return the place of the minimum of a parabola through costs (3,) at −1, 0 and 1, without limits."""
    bend = max(costs[0] - 2.0 * costs[1] + costs[2], 1e-9)
    return float(0.5 * (costs[0] - costs[2]) / bend)


def _half(costs: FloatArray) -> tuple[float, float]:
    """Return the place of the minimum of a part of the pairs, in steps, and its standard deviation."""
    total = costs.sum(axis=1)
    parts = [costs[:, start::_MIN_BLOCKS].sum(axis=1) for start in range(_MIN_BLOCKS)]
    without = np.array([_newton_step(total - part) for part in parts])
    sigma = np.sqrt((_MIN_BLOCKS - 1) / _MIN_BLOCKS * ((without - without.mean()) ** 2).sum())
    return _newton_step(total), float(sigma)


def _few_blocks_factor(blocks: int) -> float:
    """Return the factor of a standard deviation that was estimated from a few independent blocks.

    Few blocks often have similar estimates by chance. The factor is that of a 95 % interval.
    """
    from scipy.special import ndtri, stdtrit  # scipy.stats takes a second to import.

    return float(stdtrit(blocks - 1, 0.975) / ndtri(0.975))
