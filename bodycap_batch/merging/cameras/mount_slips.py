"""Find the instant at which the mount of a camera slips: the camera jumps to another place on the body.

A limb moves smoothly; a strap that slips changes the pose of the camera from one frame to the next, and the
change stays. Two hypotheses about the frames around each instant are compared: a smooth motion, and a smooth
motion with a step of the camera in its own axes. The motion is a Gaussian process: the acceleration is white
noise, or changes over a tenth of a second. The sizes of acceleration and of the noise of the poses differ
from moment to moment. So each hypothesis is averaged over a grid of motions, weighted by how often they occur
in the rest of the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.cameras.track_outliers import NEXT_FRAME
from bodycap_batch.model.geometry import (
    invert,
    make_transform,
    pose_vectors,
    rotation_angle_rad,
    so3_exp,
    so3_log,
)
from bodycap_batch.model.skeleton import MountSlip

_FRAME_S = 1.0 / 30.0
"""Interval, seconds, of the frames that are compared. Of a faster camera, every n-th frame is used, because a
strap takes some hundredths of a second to slip."""
_HALF_FRAMES = 6
"""Number of frames before and after the instant. Evidence: docs/decisions/merging.md."""
_MIN_SPAN_S, _MAX_SPAN_S = 0.5 * (2 * _HALF_FRAMES - 1) * _FRAME_S, 0.6
"""Limits of the time (seconds) from the first to the last of these frames. Longer windows have lost frames;
shorter ones have wrong timestamps. Derivation: half of the usual time; 20 frames a second."""
_STEP_SIGMAS = float(np.radians(10.0)), 0.03
"""Sigma of the step of a slip per axis: radians, metres. Derivation: turns of about 15°, moves of about 3
cm and more."""
_MAX_TRANSITION_FRAMES = 2
"""Maximum number of frames at which the camera is under way from its old to its new place. Evidence:
docs/decisions/merging.md."""
_LOG_EVIDENCE = 8.5
"""Minimum logarithm of the ratio of the likelihoods of a slip and of no slip. Evidence:
docs/decisions/merging.md."""
_MISSING_INTERVALS = 0.5, 3.5
"""Limits of the number of frame intervals that a recording lacks at one instant. Evidence:
docs/decisions/merging.md."""
_INTERVALS = 13
"""Number of possible intervals between these limits. Evidence: none."""
_USUAL_WINDOWS = 300
"""Number of windows of a take of 10 s, as those that determined the minimum evidence."""
_MIN_STEP = float(np.radians(5.0)), 0.015
"""Minimum step of a slip: radians, or metres. A smaller step is within the uncertainty of a mount."""

_PIVOT_ITERATIONS = 10
"""Number of iterations of the robust fit of the pivot. Evidence: none."""
_SMOOTH_S = 0.1
"""Correlation time (seconds) of the acceleration of a smooth motion. Evidence: docs/decisions/merging.md."""
_INTEGRATION_S = 0.005
"""Step (seconds) of the numerical integration of the acceleration. Derivation: a sixth of a frame
interval."""
_WINDOWS_AT_ONCE = 1000
"""Number of windows that are compared at once, and that show how often each motion occurs. Derivation: they
need 140 MB."""
_EM_ITERATIONS = 15
"""Number of iterations that fit the shares of the motions. Evidence: none."""
_FREE_SHARE = 0.002
"""Share that is distributed evenly over the possible motions, so that none is excluded. Evidence: none."""
_MAX_STEP_M = 0.1
"""Maximum step of a slip, metres. Derivation: a strap keeps a camera within the width of the limb."""


class _Part(NamedTuple):
    """The rotation, or the translation, and its possible motions.

    Attributes:
        noise: (G,) sigma of a pose per axis: radians or metres.
        change: (G,) standard deviation per axis that the motion adds to a constant velocity in one frame
            interval: radians or metres.
        is_smooth: (G,) True if the acceleration changes over `_SMOOTH_S`, False if it is white noise.
        step_sigma: Sigma of a step per axis: radians or metres.
        free_sigma: Sigma of the place and of the movement in a window: radians or metres.
    """

    noise: FloatArray
    change: FloatArray
    is_smooth: BoolArray
    step_sigma: float
    free_sigma: float


def _part(noise: tuple[float, float], change: tuple[float, float], step: float, free: float) -> _Part:
    noises, changes, is_smooth = (
        each.reshape(-1)
        for each in np.meshgrid(np.geomspace(*noise, 6), np.geomspace(*change, 9), np.array([False, True]))
    )
    return _Part(noises, changes, is_smooth, step, free)


_PARTS = (
    _part(
        (np.radians(0.01), np.radians(0.6)), (np.radians(0.1), np.radians(30.0)), _STEP_SIGMAS[0], free=3.0
    ),
    _part((3e-4, 8e-3), (5e-4, 0.1), _STEP_SIGMAS[1], free=10.0),
)
"""Rotation (radians) and translation (metres). The noise covers paths of finished maps. Evidence:
docs/decisions/merging.md."""


class _Windows(NamedTuple):
    """The frames around W instants.

    Attributes:
        first_after: (W,) index of the first frame after each instant.
        times_s: (W,2K) times of the frames after the first one, seconds.
        rotation: (W,2K,3,3) orientations.
        moves: Rotation vectors of the camera, and movements of the pivot, (W,2K,3), from the last frame
            before the instant.
    """

    first_after: IntArray
    times_s: FloatArray
    rotation: FloatArray
    moves: tuple[FloatArray, FloatArray]

    def take(self, index: IntArray | slice) -> _Windows:
        """Return some of the windows."""
        moves = (self.moves[0][index], self.moves[1][index])
        return _Windows(self.first_after[index], self.times_s[index], self.rotation[index], moves)


class _Likelihoods(NamedTuple):
    """The hypotheses about W windows and G motions.

    Attributes:
        smooth: (W,G) log-likelihood of a smooth motion.
        slipped: (W,G) log-likelihood of a smooth motion and a step.
        step: (W,G,3) most likely step in the axes of the camera after it: a rotation vector, or metres.
        variance: (W,G) mean variance of the step over its axes.
    """

    smooth: FloatArray
    slipped: FloatArray
    step: FloatArray
    variance: FloatArray


def find_slip(track: CameraTrack) -> MountSlip | None:
    """Return the slip of a camera's mount.

    Args:
        track: Path of the camera without gross errors, metres. A provisional scale is accurate enough.

    Returns:
        The slip. None without one. None also if the path has several such steps: then the poses jump for
        another reason, such as a wrong part of the map.
    """
    steps = _steps(track)
    return steps[0] if len(steps) == 1 else None


def without_slip(track: CameraTrack, slip: MountSlip, scale: float) -> CameraTrack:
    """Return the path that the camera would have at its place before a slip.

    Args:
        track: Path of the camera, map units.
        slip: The slip, metres.
        scale: Metres per map unit.
    """
    poses = slip.scaled(1.0 / scale).as_before(track.map_from_cam, track.times_ns)
    return replace(track, map_from_cam=poses)


def _steps(track: CameraTrack) -> list[MountSlip]:
    """Return the steps of a path, without blocks of frames from which the path comes back."""
    stride = max(1, round(_FRAME_S * 1e9 / float(np.median(np.diff(track.times_ns)))))
    frames = np.arange(0, len(track.times_ns), stride)
    pivot_in_cam = make_transform(np.eye(3), _pivot_m(track, frames))
    windows = _windows(replace(track, map_from_cam=track.map_from_cam @ pivot_in_cam), frames)
    if not len(windows.first_after):
        return []
    numbers = np.arange(len(windows.first_after))
    sample = evenly_spaced(len(numbers), _WINDOWS_AT_ONCE)
    occurrences = [_occurrence(each.smooth) for each in _both_parts(windows.take(sample))]

    def weights_of(some: IntArray) -> list[FloatArray]:
        return [_weights_elsewhere(some, sample, each) for each in occurrences]

    by_duration = np.hstack(
        [
            _slip_evidence(windows.take(some), weights_of(some))
            for some in np.split(numbers, np.arange(_WINDOWS_AT_ONCE, len(numbers), _WINDOWS_AT_ONCE))
        ]
    )
    evidence = np.asarray(logsumexp(by_duration, axis=0) - np.log(len(by_duration)))
    # A slip is as likely in a long take as in a short one, but a long take has more instants.
    evidence -= np.log(max(1.0, len(evidence) / _USUAL_WINDOWS))
    out: list[MountSlip] = []
    for index in _peaks(evidence):
        window, weights = windows.take(slice(index, index + 1)), weights_of(np.array([index]))
        if evidence[index] - _wrong_frames_evidence(window, weights) < _LOG_EVIDENCE:
            continue
        under_way = _transitions()[int(np.argmax(by_duration[:, index]))]
        first_after = int(window.first_after[0])
        time_ns = int(track.times_ns[first_after])
        step = _mean_step(time_ns, _both_parts(window, under_way), weights, pivot_in_cam)
        if out and _undoes(step.before_from_after, out[-1].before_from_after):
            out.pop()
        elif _is_slip(step.before_from_after) and not _is_along_path(track, step, first_after, stride):
            out.append(step)
    return out


def _pivot_m(track: CameraTrack, frames: IntArray) -> FloatArray:
    """Return the point (3,) fixed to the camera that accelerates least, metres.

    It is near the joint about which the limb turns. Its path is smoother than the camera's, so that a step is
    easier to see.
    """
    poses, times = track.map_from_cam[frames], track.times_ns[frames]
    even = np.diff(times) < NEXT_FRAME * np.median(np.diff(times))
    even = even[1:] & even[:-1]
    turn, move = (np.diff(poses[:, :3, axes], n=2, axis=0)[even] for axes in (slice(3), 3))
    pivot, weight = np.zeros(3), np.ones(len(turn))
    for _ in range(_PIVOT_ITERATIONS if len(turn) else 0):
        normal = np.einsum("n,nij,nik->jk", weight, turn, turn)
        target = np.einsum("n,nij,ni->j", weight, turn, move)
        pivot = -np.linalg.solve(normal + 1e-9 * np.eye(3), target)
        off = np.linalg.norm(move + turn @ pivot, axis=1)
        weight = 1.0 / (1.0 + (off / max(float(np.median(off)), 1e-9)) ** 2)
    return pivot


def _transitions() -> list[BoolArray]:
    """Return, for each possible duration of a slip, the frames (2K,) at which the camera is under way."""
    frames = np.arange(2 * _HALF_FRAMES) - _HALF_FRAMES
    return [(frames >= 0) & (frames < length) for length in range(_MAX_TRANSITION_FRAMES + 1)]


def _windows(track: CameraTrack, frames: IntArray) -> _Windows:
    """Return the windows around the instants before the frames, without windows with lost frames."""
    first = np.arange(_HALF_FRAMES, len(frames) - _HALF_FRAMES + 1)
    index = frames[first[:, None] + np.arange(-_HALF_FRAMES, _HALF_FRAMES)]
    times_s = 1e-9 * (track.times_ns[index] - track.times_ns[index[:, :1]])
    kept = (times_s[:, -1] >= _MIN_SPAN_S) & (times_s[:, -1] <= _MAX_SPAN_S)
    index, times_s = index[kept], times_s[kept]
    poses = track.map_from_cam[index]
    last = poses[:, _HALF_FRAMES - 1, None]
    turns = so3_log(poses[..., :3, :3] @ np.swapaxes(last[..., :3, :3], -1, -2))
    moves = turns, poses[..., :3, 3] - last[..., :3, 3]
    return _Windows(index[:, _HALF_FRAMES], times_s, poses[..., :3, :3], moves)


def _likelihoods(
    windows: _Windows, part: _Part, move: FloatArray, wrong: BoolArray | None = None
) -> _Likelihoods:
    """Compare a smooth motion with a smooth motion and a step, for each possible motion of a part.

    Args:
        windows: The windows.
        part: Rotation or translation.
        move: (W,2K,3) rotation vectors or translations.
        wrong: (2K,) True for frames whose poses may be wrong by as much as a step; None without such frames.
    """
    count, size, frames = len(move), len(part.noise), move.shape[1]
    out = _Likelihoods(*(np.empty((count, size, *shape)) for shape in ((), (), (3,), ())))
    after = windows.rotation[:, _HALF_FRAMES:]
    rounded, pattern = np.unique(np.round(500.0 * windows.times_s), axis=0, return_inverse=True)
    for number, times in enumerate(rounded / 500.0):
        chosen = np.flatnonzero(pattern.reshape(-1) == number)
        precision, log_determinant = _precisions(times, part, wrong)
        by_frame = move[chosen].transpose(1, 0, 2)
        explained = (precision.reshape(-1, frames) @ by_frame.reshape(frames, -1)).reshape(
            size, *by_frame.shape
        )
        smooth = -0.5 * (explained * by_frame).sum(axis=(1, 3)).T - 1.5 * log_determinant
        turns = after[chosen].reshape(len(chosen), -1, 3)
        explained_after = explained[:, _HALF_FRAMES:].transpose(2, 0, 1, 3).reshape(len(chosen), size, -1)
        gradient = explained_after @ turns
        turned = np.einsum("waij,wbik->abwjk", after[chosen], after[chosen])
        weight = precision[:, _HALF_FRAMES:, _HALF_FRAMES:].reshape(size, -1)
        information = (weight @ turned.reshape(_HALF_FRAMES**2, -1)).reshape(size, -1, 3, 3).swapaxes(0, 1)
        inverse_posterior = information + np.eye(3) / part.step_sigma**2
        posterior = np.linalg.inv(inverse_posterior)
        step = (posterior @ gradient[..., None])[..., 0]
        occam = np.linalg.slogdet(part.step_sigma**2 * inverse_posterior)[1]
        out.smooth[chosen] = smooth
        out.slipped[chosen] = smooth + 0.5 * (gradient * step).sum(axis=-1) - 0.5 * occam
        out.step[chosen] = step
        out.variance[chosen] = np.trace(posterior, axis1=-2, axis2=-1) / 3.0
    return out


def _precisions(times_s: FloatArray, part: _Part, wrong: BoolArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the inverse covariances (G,2K,2K) of a coordinate, and their log-determinants (G,).

    Args:
        times_s: (2K,) times of the frames after the first one, seconds.
        part: Rotation or translation.
        wrong: (2K,) True for frames whose poses may be wrong; None without such frames.
    """
    earlier, later = np.minimum.outer(times_s, times_s), np.maximum.outer(times_s, times_s)
    # Covariance of the acceleration that is integrated twice, per variance of the change in one interval.
    white = (earlier**2 * later / 2.0 - earlier**3 / 6.0) / (_FRAME_S**3 / 3.0)
    integrated = np.where(part.is_smooth[:, None, None], _smooth_covariance(times_s), white)
    free = np.column_stack([np.ones_like(times_s), times_s / times_s[-1]])
    fixed = part.free_sigma**2 * free @ free.T
    if wrong is not None:
        fixed += part.step_sigma**2 * np.diag(wrong)
    noise = (part.noise**2)[:, None, None] * np.eye(len(times_s))
    covariance = (part.change**2)[:, None, None] * integrated + noise + fixed
    return np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]


def _smooth_covariance(times_s: FloatArray) -> FloatArray:
    """Return the covariance (2K,2K) of an acceleration that is integrated twice, per `_FRAME_S`^4.

    The acceleration has the Matérn covariance (3/2) with the time `_SMOOTH_S` and a variance of 1.

    Args:
        times_s: (2K,) times of the frames after the first one, seconds.
    """
    instants = np.arange(0.0, times_s[-1], _INTEGRATION_S)
    apart = np.sqrt(3.0) * np.abs(instants[:, None] - instants) / _SMOOTH_S
    integral = np.clip(times_s[:, None] - instants, 0.0, None) * _INTEGRATION_S
    return np.asarray(integral @ ((1.0 + apart) * np.exp(-apart)) @ integral.T / _FRAME_S**4)


def _occurrence(smooth: FloatArray) -> FloatArray:
    """Return the probabilities (W,G) of the motions in each window: a mixture, fitted by EM.

    Args:
        smooth: (W,G) log-likelihood of each window and motion.
    """
    size = smooth.shape[1]
    weights = np.full(size, -np.log(size))
    for _ in range(_EM_ITERATIONS):
        probability = smooth + weights
        probability = np.exp(probability - logsumexp(probability, axis=1, keepdims=True))
        weights = _log_shares(probability.mean(axis=0))
    return np.asarray(probability)


def _log_shares(shares: FloatArray) -> FloatArray:
    return np.asarray(np.log((1.0 - _FREE_SHARE) * shares + _FREE_SHARE / shares.shape[-1]))


def _weights_elsewhere(windows: IntArray, sample: IntArray, occurrence: FloatArray) -> FloatArray:
    """Return the logarithms (W,G) of the shares of the motions in the path without each window.

    The windows that contain a slip do not show how the limb usually moves.

    Args:
        windows: (W,) numbers of the windows.
        sample: (S,) numbers of the windows whose motions are known, increasing.
        occurrence: (S,G) probabilities of the motions in these windows.
    """
    around = _HALF_FRAMES + _MAX_TRANSITION_FRAMES
    first, last = np.searchsorted(sample, windows - around), np.searchsorted(sample, windows + around + 1)
    total = np.vstack([np.zeros(occurrence.shape[1]), np.cumsum(occurrence, axis=0)])
    # Without other windows, each motion is as likely as any other.
    rest = total[-1] - (total[last] - total[first]) + 1e-6
    return _log_shares(rest / rest.sum(axis=1, keepdims=True))


def _both_parts(windows: _Windows, wrong: BoolArray | None = None) -> list[_Likelihoods]:
    """Return the likelihoods of the rotation and of the translation, with frames (2K,) that may be wrong."""
    return [
        _likelihoods(windows, part, move, wrong) for part, move in zip(_PARTS, windows.moves, strict=True)
    ]


def _slip_evidence(windows: _Windows, weights: Sequence[FloatArray]) -> FloatArray:
    """Return the log of the ratio (D,W) of the likelihoods of a slip and of a smooth motion.

    Args:
        windows: The windows.
        weights: (W,G) log of the shares of the motions, for rotation and translation.

    Returns:
        The ratios for D durations of the slip, see `_transitions`.
    """
    usual = [
        logsumexp(each.smooth + weight, axis=1)
        for each, weight in zip(_both_parts(windows), weights, strict=True)
    ]
    out = []
    for wrong in _transitions():
        found = _both_parts(windows, wrong)
        slipped, still = (
            [
                logsumexp(values + weight, axis=1) - base
                for values, weight, base in zip(part, weights, usual, strict=True)
            ]
            for part in ([each.slipped for each in found], [each.smooth for each in found])
        )
        # A slip turns the camera, or moves it, or both.
        either = [slipped[0] + slipped[1], slipped[0] + still[1], still[0] + slipped[1]]
        out.append(logsumexp(either, axis=0) - np.log(3.0))
    return np.array(out)


def _wrong_frames_evidence(window: _Windows, weights: Sequence[FloatArray]) -> float:
    """Return the log of the ratio of the likelihoods of a smooth motion with and without wrong frames.

    Some frames beside the instant may be wrong, or none.
    """
    frames = np.arange(2 * _HALF_FRAMES)
    blocks = [np.zeros(len(frames), dtype=np.bool_)]
    for length in range(1, _HALF_FRAMES):
        blocks.append((frames >= _HALF_FRAMES) & (frames < _HALF_FRAMES + length))
        blocks.append((frames < _HALF_FRAMES) & (frames >= _HALF_FRAMES - length))
    total = [
        sum(
            float(logsumexp(each.smooth + weight))
            for each, weight in zip(_both_parts(window, block), weights, strict=True)
        )
        for block in blocks
    ]
    some = logsumexp(total[1:]) - np.log(len(total) - 1)
    return float(np.logaddexp(0.0, some - total[0]))


def _is_along_path(track: CameraTrack, step: MountSlip, first_after: int, stride: int) -> bool:
    """Return True if a step is rather what the camera moves in a few frame intervals than a slip.

    Such a step comes from frames that the recording lacks although its timestamps do not show it. The
    likelihoods of both are compared. A slip turns the camera, or moves it, or both.

    Args:
        track: Path of the camera.
        step: A step of the path.
        first_after: Index of the first frame after the step.
        stride: Number of frames of the track for each frame that is compared.
    """
    index = first_after + stride * np.arange(-_HALF_FRAMES // 2, _HALF_FRAMES // 2)
    moves = pose_vectors(invert(track.map_from_cam[index[:-1]]) @ track.map_from_cam[index[1:]])
    moves = np.delete(moves, _HALF_FRAMES // 2 - 1, axis=0)
    velocity = np.median(moves, axis=0)
    spread = ((moves - velocity) ** 2).mean(axis=0).reshape(2, 3).mean(axis=1)
    intervals = np.linspace(*_MISSING_INTERVALS, _INTERVALS)[:, None]
    kinds = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])

    def log_likelihood(means: FloatArray, variances: FloatArray) -> float:
        variances = np.repeat(variances + np.array([step.sigma_rad, step.sigma_m]) ** 2, 3, axis=1)
        square = (pose_vectors(step.before_from_after[None]) - means) ** 2 / variances
        values = -0.5 * (square + np.log(variances)).sum(axis=1)
        return float(logsumexp(values) - np.log(len(values)))

    along = log_likelihood(intervals * velocity, intervals**2 * spread)
    return along > log_likelihood(np.zeros(6), kinds * np.array(_STEP_SIGMAS) ** 2)


def _peaks(evidence: FloatArray) -> list[int]:
    """Return the windows with enough evidence of a slip, and with more than the windows beside them."""
    out: list[int] = []
    rest = evidence.copy()
    while rest.max() >= _LOG_EVIDENCE:
        index = int(np.argmax(rest))
        out.append(index)
        rest[max(0, index - _HALF_FRAMES + 1) : index + _HALF_FRAMES] = -np.inf
    return sorted(out)


def _mean_step(
    time_ns: int,
    found: Sequence[_Likelihoods],
    weights: Sequence[FloatArray],
    pivot_in_cam: FloatArray,
) -> MountSlip:
    """Return the mean step of one window over the motions, and its sigmas.

    Args:
        time_ns: Common time of the first frame after the step.
        found: Likelihoods of rotation and translation in this one window; the translation is the pivot's.
        weights: (1,G) log of the shares of the motions, for rotation and translation.
        pivot_in_cam: (4,4) axes of the camera at the pivot, in the camera's frame.
    """
    means, sigmas = [], []
    for each, weight in zip(found, weights, strict=True):
        slipped, steps = each.slipped[0] + weight[0], each.step[0]
        share = np.exp(slipped - logsumexp(slipped))
        mean = share @ steps
        spread = ((steps - mean) ** 2).mean(axis=1)
        means.append(mean)
        sigmas.append(float(np.sqrt(share @ (each.variance[0] + spread))))
    turn = so3_exp(means[0])
    # The translation was fitted in the axes of the camera after the step.
    step = pivot_in_cam @ make_transform(turn, turn @ means[1]) @ invert(pivot_in_cam)
    arm_m = float(np.linalg.norm(pivot_in_cam[:3, 3])) * np.sqrt(2.0 / 3.0)
    return MountSlip(
        time_ns=time_ns,
        before_from_after=step,
        sigma_rad=sigmas[0],
        sigma_m=float(np.hypot(sigmas[1], arm_m * sigmas[0])),
    )


def _undoes(step: FloatArray, previous: FloatArray) -> bool:
    """Return True if the path comes back: two steps (4,4) together are less than half of the first."""
    return not _is_large(previous @ step, _sizes(previous) / 2.0)


def _sizes(step: FloatArray) -> FloatArray:
    return np.array([float(rotation_angle_rad(step[:3, :3])), float(np.linalg.norm(step[:3, 3]))])


def _is_slip(step: FloatArray) -> bool:
    return _is_large(step) and float(_sizes(step)[1]) <= _MAX_STEP_M


def _is_large(step: FloatArray, limits: FloatArray | tuple[float, float] = _MIN_STEP) -> bool:
    """Return True if a step (4,4) turns or moves the camera by more than the limits: radians, metres."""
    return bool((_sizes(step) > np.maximum(limits, _MIN_STEP)).any())
