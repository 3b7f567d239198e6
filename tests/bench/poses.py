"""Check the stated covariances of tracked poses: normalised errors of a job's frames.

The first figure is the squared error of a pose over its stated covariance and its dimensions; it is 1 if the
covariance is correct. The second is the fraction of frames inside the 95 % region. Errors of successive
frames are correlated, so a clip's mean has no useful confidence band; the fraction of frames is compared with
95 %.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from bodycap_batch import Result
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.evaluate.trajectories import interpolate_truth
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.model.geometry import (
    Similarity,
    align_points,
    invert,
    make_transform,
    so3_exp,
    so3_log,
)
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.tasks.loading import load_registration

_SOLVERS = ("registration", "recover", "rig")
_LEAST_POSES = 3
_INSIDE = 0.95
_MAX_UNEVEN = 0.15
"""Largest deviation of an interval between true poses from the median one, where their noise is measured."""
_THIRD_DIFFERENCE_GAIN = 20.0
"""Variance of a third difference of independent values with the variance 1: 1 + 9 + 9 + 1."""
_VELOCITY_SAMPLES = 5
"""Number of true poses before and after a frame that give the velocity of a measured truth."""
_GROSS = 3.0
"""Scale of the Cauchy loss in sigmas: larger errors have less and less influence on the alignment."""
_PARTS = {"rotation": slice(0, 3), "centre": slice(3, 6), "pose": slice(0, 6)}


def last_poses(results: Path, store: Path) -> dict[str, Trajectory]:
    """Return the poses of every camera after the last stage that estimated them."""
    folders = {
        stage["camera"]: store / stage["artefact"]
        for stage in Result(results).record()["stages"]
        if stage["stage"] in _SOLVERS and stage["camera"] and stage.get("artefact")
    }
    return {name: load_registration(folder).trajectory for name, folder in sorted(folders.items())}


def consistency(results: Path, store: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Return `figures` per camera, and for ``all`` cameras in the map of most cameras under one similarity.

    Args:
        results: A job's results.
        store: The store in which it ran.
        truth: Folder with ``<camera>.tum``, or the file of the only camera. A file was measured, so it has
            errors of its own: see `MeasuredTruth`. If the folder holds ``exposure/<camera>.tum``, the mean
            poses over the exposures, these are the truth: a picture with motion blur shows them.
    """
    truth = shown_truth(truth)
    paths, true = _with_truth(last_poses(results, store), truth)
    if sum(map(len, true)) < _LEAST_POSES:
        return {}
    stated = np.concatenate([path.covariance[scored] for path, scored in paths])
    mine = np.concatenate([path.gauge_from_cam[scored] for path, scored in paths])
    if truth.is_dir():
        errors = least_errors(mine, np.concatenate(true), stated)
    else:
        measured = MeasuredTruth.create(read_tum(truth), paths[0][0].times_ns[paths[0][1]])
        scale = align_points(true[0][:, :3, 3], mine[:, :3, 3]).scale
        unit = np.repeat([1.0, scale], 3)
        stated = stated + measured.noise * np.outer(unit, unit)
        errors = least_errors(mine, true[0], stated, measured.twist)
    names = np.concatenate([np.full(scored.sum(), path.camera) for path, scored in paths])
    out = {name: figures(errors[names == name], stated[names == name]) for name in np.unique(names).tolist()}
    return {**out, "all": figures(errors, stated)}


def shown_truth(truth: Path) -> Path:
    """Return the folder with the poses that the pictures of a capture show, or the file of the truth."""
    return truth / "exposure" if (truth / "exposure").is_dir() else truth


def _with_truth(
    paths: dict[str, Trajectory], truth: Path
) -> tuple[list[tuple[Trajectory, BoolArray]], list[FloatArray]]:
    """Return the paths in the map of most cameras with a mask (N,) of frames with a truth, and that truth
    (K,4,4).
    """
    gauges = Counter(path.gauge for path in paths.values() if path.localised.any())
    known, poses = [], []
    for name, path in paths.items():
        file = truth / f"{name}.tum" if truth.is_dir() else truth
        if not file.exists() or path.gauge != gauges.most_common(1)[0][0]:
            continue
        true, found = interpolate_truth(read_tum(file), path.times_ns)
        scored = np.asarray(path.localised & found)
        if scored.any():
            known.append((path, scored))
            poses.append(true[scored])
    return known, poses


@dataclass(frozen=True)
class MeasuredTruth:
    """The errors of a truth that a tracking system measured.

    Attributes:
        noise: (N,6,6) covariance of the noise of each true pose, rotation and centre in the axes of the
            camera (rad, m). It is the noise that the truth itself shows between its samples; slower errors
            of the tracking system are not contained.
        twist: (N,6) change of the true pose in a second, in the same axes. The clocks of the tracking system
            and of the camera differ by a constant time, which the alignment estimates with it, and with the
            constant pose of the camera in the tracked body.
    """

    noise: FloatArray
    twist: FloatArray

    @staticmethod
    def create(truth: TimedPoses, times_ns: IntArray) -> MeasuredTruth:
        """Return the errors of the truth at the times (N,) of the frames.

        The noise follows from third differences of successive samples: the motion hardly changes them. The
        interpolation between two samples averages their noise.
        """
        step = invert(truth.world_from_cam[:-1]) @ truth.world_from_cam[1:]
        change = np.concatenate([so3_log(step[:, :3, :3]), step[:, :3, 3]], axis=1)
        interval = np.diff(truth.times_ns)
        is_even = np.abs(interval / np.median(interval) - 1.0) < _MAX_UNEVEN
        is_even = is_even[2:] & is_even[1:-1] & is_even[:-2]
        bend = np.diff(change, 2, axis=0)[is_even]
        noise = bend.T @ bend / max(len(bend), 1) / _THIRD_DIFFERENCE_GAIN
        after = np.clip(np.searchsorted(truth.times_ns, times_ns), 1, len(truth.times_ns) - 1)
        share = np.clip((times_ns - truth.times_ns[after - 1]) / interval[after - 1], 0.0, 1.0)
        # Over several samples, their noise hardly changes the velocity.
        first = np.maximum(after - _VELOCITY_SAMPLES, 0)
        last = np.minimum(after + _VELOCITY_SAMPLES - 1, len(truth.times_ns) - 1)
        moved = invert(truth.world_from_cam[first]) @ truth.world_from_cam[last]
        seconds = (truth.times_ns[last] - truth.times_ns[first]) * 1e-9
        twist = np.concatenate([so3_log(moved[:, :3, :3]), moved[:, :3, 3]], axis=1) / seconds[:, None]
        return MeasuredTruth(((1.0 - share) ** 2 + share**2)[:, None, None] * noise, twist)


def least_errors(
    mine: FloatArray, true: FloatArray, covariance: FloatArray, twist: FloatArray | None = None
) -> FloatArray:
    """Return `pose_errors` (N,6) under the similarity that minimises them relative to their covariances.

    A similarity that aligns only the centres of a short path is rotated by more than the stated sigmas. Gross
    errors have little influence. Evidence: docs/decisions/bench.md.

    Args:
        mine: (N,4,4) estimated poses.
        true: (N,4,4) true poses.
        covariance: (N,6,6) covariances of the errors.
        twist: (N,6) change of a measured truth in a second, from `MeasuredTruth`. If it is given, a constant
            pose of the camera in the tracked body and a constant difference of the clocks are estimated, too.
    """
    start = align_points(true[:, :3, 3], mine[:, :3, 3])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def errors(change: FloatArray) -> FloatArray:
        moved = Similarity(
            start.scale * float(np.exp(change[6])),
            so3_exp(change[:3]) @ start.rotation,
            start.translation + change[3:6],
        )
        known = true
        if twist is not None:
            delay = _motions(change[13] * twist)
            known = true @ delay @ _motions(change[7:13])
        return pose_errors(mine, moved.apply_to_poses(known))

    found = least_squares(
        lambda change: np.einsum("nij,nj->ni", whitening, errors(change)).ravel(),
        np.zeros(7 if twist is None else 14),
        loss="cauchy",
        f_scale=_GROSS,
    )
    return errors(found.x)


def _motions(change: FloatArray) -> FloatArray:
    """Return rigid motions (...,4,4) from rotation vectors and translations (...,6)."""
    return np.asarray(make_transform(so3_exp(change[..., :3]), change[..., 3:]))


def pose_errors(mine: FloatArray, true: FloatArray) -> FloatArray:
    """Return the errors (N,6) of rotation (rad) and centre against true poses (N,4,4), in each estimate's
    camera.
    """
    difference = invert(mine) @ true
    return np.concatenate([so3_log(difference[:, :3, :3]), difference[:, :3, 3]], axis=1)


def figures(errors: FloatArray, covariance: FloatArray) -> dict[str, float]:
    """Return normalised errors of poses (N,6) with stated covariances (N,6,6).

    Returns:
        For rotation, centre and both: the median squared error over the median of a chi-squared distribution,
        which is 1 if the covariance is correct; and ``<part>_inside``, the fraction of frames in the 95 %
        region. For rotation and centre, ``<part>_sigma`` is the median sigma (root of the summed variances)
        over the median error; it is 1.13 for normal errors.
    """
    out: dict[str, float] = {"frames": len(errors)}
    for name, part in _PARTS.items():
        error = errors[:, part]
        squared = (error * np.linalg.solve(covariance[:, part, part], error[..., None])[..., 0]).sum(axis=1)
        out[name] = float(np.median(squared) / chi2.median(error.shape[1]))
        out[f"{name}_inside"] = float((squared <= chi2.ppf(_INSIDE, error.shape[1])).mean())
        if error.shape[1] == 3:
            variance = np.trace(covariance[:, part, part], axis1=1, axis2=2)
            out[f"{name}_sigma"] = float(np.sqrt(np.median(variance) / np.median((error**2).sum(axis=1))))
    return out


def line_of(scores: dict[str, dict[str, float]]) -> str:
    """Return the figures of all cameras as text."""
    parts = [
        f"{name} {scores['all'][name]:.2f} ({scores['all'][name + '_inside']:.0%} inside)" for name in _PARTS
    ]
    ratio = f"; median sigma over median error {scores['all']['centre_sigma']:.2f} (centre)"
    return "stated covariance of the poses: normalised error " + ", ".join(parts) + ratio
