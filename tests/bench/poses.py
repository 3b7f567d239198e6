"""Check the stated covariances of tracked poses: normalised errors of a job's frames.

The first figure is the squared error of a pose over its stated covariance and its dimensions; it is 1 if the
covariance is correct. The second is the fraction of frames inside the 95 % region. Errors of successive
frames are correlated, so a clip's mean has no useful confidence band; the fraction of frames is compared with
95 %.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.evaluate.association import interpolate_truth
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.geometry import Similarity, align_points, invert, so3_exp, so3_log
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.tasks.loading import load_registration

_SOLVERS = ("registration", "recover", "rig")
_MAX_GAP_S = 0.1
_LEAST_POSES = 3
_INSIDE = 0.95
_GROSS = 3.0
"""Scale of the Cauchy loss in sigmas: larger errors have less and less influence on the alignment."""
_PARTS = {"rotation": slice(0, 3), "centre": slice(3, 6), "pose": slice(0, 6)}


def last_poses(results: Path, store: Path) -> dict[str, Trajectory]:
    """Return the poses of every camera after the last stage that estimated them."""
    record = json.loads((results / "run.json").read_text(encoding="utf-8"))
    folders = {
        stage["camera"]: store / stage["artefact"]
        for stage in record["stages"]
        if stage["stage"] in _SOLVERS and stage["camera"] and stage.get("artefact")
    }
    return {name: load_registration(folder).trajectory for name, folder in sorted(folders.items())}


def consistency(results: Path, store: Path, truth: Path) -> dict[str, dict[str, float]]:
    """Return `figures` per camera, and for ``all`` cameras in the map of most cameras under one similarity.

    Args:
        results: A job's results.
        store: The store in which it ran.
        truth: Folder with ``<camera>.tum``, or the file of the only camera.
    """
    paths, true = _with_truth(last_poses(results, store), truth)
    if sum(map(len, true)) < _LEAST_POSES:
        return {}
    stated = np.concatenate([path.covariance[scored] for path, scored in paths])
    mine = np.concatenate([path.gauge_from_cam[scored] for path, scored in paths])
    errors = least_errors(mine, np.concatenate(true), stated)
    names = np.concatenate([np.full(scored.sum(), path.camera) for path, scored in paths])
    out = {name: figures(errors[names == name], stated[names == name]) for name in np.unique(names).tolist()}
    return {**out, "all": figures(errors, stated)}


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
        true, found = interpolate_truth(read_tum(file), path.times_ns, _MAX_GAP_S)
        scored = np.asarray(path.localised & found)
        if scored.any():
            known.append((path, scored))
            poses.append(true[scored])
    return known, poses


def least_errors(mine: FloatArray, true: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return `pose_errors` (N,6) under the similarity that minimises them relative to their covariances.

    A similarity that aligns only the centres of a short path is rotated by more than the stated sigmas. Gross
    errors have little influence. Evidence: docs/decisions/bench.md.
    """
    start = align_points(true[:, :3, 3], mine[:, :3, 3])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))

    def errors(change: FloatArray) -> FloatArray:
        moved = Similarity(
            start.scale * float(np.exp(change[6])),
            so3_exp(change[:3]) @ start.rotation,
            start.translation + change[3:6],
        )
        return pose_errors(mine, moved.apply_to_poses(true))

    found = least_squares(
        lambda change: np.einsum("nij,nj->ni", whitening, errors(change)).ravel(),
        np.zeros(7),
        loss="cauchy",
        f_scale=_GROSS,
    )
    return errors(found.x)


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
