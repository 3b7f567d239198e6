"""Match keyframe pairs and verify them: one matrix product and one essential matrix a pair."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera
from bodycap_batch.model.optical_flow import pixel_scale

if TYPE_CHECKING:
    import pycolmap

Descriptors = npt.NDArray[np.float32]

MIN_INLIERS = 15
"""COLMAP's own: the mapper does not look at pairs with fewer."""
_MAX_RATIO = 0.8
_MAX_ANGLE_RAD = 0.7
"""Nearest to second nearest descriptor, as angles, and the largest angle of a match: COLMAP's own."""
_NORM = 512.0
"""Length of a descriptor: root-normalised bytes. Their products are whole numbers below 2^24, which
float32 adds up exactly in any order: threads and libraries cannot change a match."""
_MAX_ERROR_PX = 4.0
_MAX_TRIALS = 400
"""Samples of a robust fit. COLMAP's 10,000 spend 60 ms on every pair that has nothing in common; a pair of
which one match in three holds is found with 400 samples of five (0.33^5 x 400 = 1.6 right samples)."""
_CONFIDENCE = 0.999
_MAX_TANGENT = 2.5
"""Rays further off axis than this (68 degrees) stretch the plane too much to measure errors in it."""
_BLOCK = 512
_CALIBRATED = 2
_UNCALIBRATED = 3
_CV_ASSERTION_FAILED = -215


@dataclass(frozen=True, slots=True)
class KeyframeFeatures:
    """What matching needs of a keyframe.

    Attributes:
        descriptors: (N,128) uint8.
        rays: (N,2) undistorted, at depth 1; pixels of a camera whose lens is not known.
        error: Allowed distance in the unit of `rays`.
        calibrated: False where the lens is a guess.
    """

    descriptors: npt.NDArray[np.uint8]
    rays: FloatArray
    error: float
    calibrated: bool


def match_pairs(
    workspace: Path,
    pairs: Sequence[Pair],
    cameras: Mapping[str, tuple[Camera, bool]],
    context: StageContext,
) -> dict[Pair, int]:
    """Match and verify keyframe pairs into the database.

    Args:
        workspace: Folder of the database.
        pairs: Pairs to match.
        cameras: Lens of each camera, and whether it is known.
        context: Threads, progress, cancellation.

    Returns:
        Matches of each pair that held.

    Source: Lowe, IJCV 2004 (ratio test); Barath et al., "MAGSAC++", CVPR 2020 and Raguram et al., "USAC",
        PAMI 2013, as OpenCV has them, for the robust fit.
    """
    import pycolmap

    held: dict[Pair, int] = {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        views = _read_features(database, ids, {ref for pair in pairs for ref in pair}, cameras)
        for done in range(0, len(pairs), _BLOCK):
            context.progress(done, len(pairs), "pairs")
            block = pairs[done : done + _BLOCK]
            with pycolmap.DatabaseTransaction(database):
                for (a, b), matches in zip(block, _match_block(block, views, context), strict=True):
                    if len(matches) >= MIN_INLIERS:
                        calibrated = views[a].calibrated and views[b].calibrated
                        _write_matches(database, ids[a], ids[b], matches, calibrated=calibrated)
                        held[a, b] = len(matches)
    context.progress(len(pairs), len(pairs), "pairs")
    return held


def _read_features(
    database: pycolmap.Database,
    ids: Mapping[ImageRef, int],
    refs: set[ImageRef],
    cameras: Mapping[str, tuple[Camera, bool]],
) -> dict[ImageRef, KeyframeFeatures]:
    out = {}
    for ref in sorted(refs):
        lens, calibrated = cameras[ref.camera]
        pixels = np.asarray(database.read_keypoints(ids[ref]), dtype=np.float64)[:, :2]
        error = _MAX_ERROR_PX * pixel_scale(lens.width_px, lens.height_px)
        out[ref] = KeyframeFeatures(
            descriptors=np.asarray(database.read_descriptors(ids[ref]).data),
            rays=lens.unproject(pixels) if calibrated else pixels - CV2_PIXEL_OFFSET_PX,
            error=error / lens.focal_px if calibrated else error,
            calibrated=calibrated,
        )
    return out


def _match_block(
    pairs: Sequence[Pair], views: Mapping[ImageRef, KeyframeFeatures], context: StageContext
) -> Iterator[IntArray]:
    """Verified matches of each pair, in the order of the pairs."""
    parts = [pairs[start :: context.threads] for start in range(context.threads)]

    def work(part: Sequence[Pair]) -> list[IntArray]:
        out, last, first = [], None, np.zeros((0, 128), np.float32)
        for a, b in part:
            context.check_cancelled()
            if a != last:
                last, first = a, views[a].descriptors.astype(np.float32)
            found = find_mutual_matches(first, views[b].descriptors.astype(np.float32))
            out.append(verify_pair(found, views[a], views[b]))
        return out

    with ThreadPoolExecutor(context.threads) as pool:
        done = [iter(result) for result in pool.map(work, parts)]
    for number in range(len(pairs)):
        yield next(done[number % context.threads])


def find_mutual_matches(first: Descriptors, second: Descriptors) -> IntArray:
    """Pairs (M,2) of features that are each other's nearest, clearly nearer than the next.

    Args:
        first: (N,128) root-normalised descriptors, as floats.
        second: (M,128).
    """
    if len(first) < MIN_INLIERS or len(second) < MIN_INLIERS:
        return np.zeros((0, 2), dtype=np.int64)
    alike = first @ second.T
    row = np.arange(len(first))
    nearest = alike.argmax(axis=1)
    best = alike[row, nearest]
    mutual = best == alike.max(axis=0)[nearest]
    near = np.flatnonzero(mutual & (best > np.cos(_MAX_ANGLE_RAD) * _NORM**2))
    alike[near, nearest[near]] = -1.0
    second_best = alike[near].max(axis=1, initial=-1.0)
    near = near[_angle(best[near]) < _MAX_RATIO * _angle(second_best)]
    # Two features can be equally near to a third: the first has it.
    _, once = np.unique(nearest[near], return_index=True)
    near = near[np.sort(once)]
    return np.column_stack([near, nearest[near]])


def _angle(alike: npt.NDArray[np.float32]) -> FloatArray:
    return np.asarray(np.arccos(np.clip(alike.astype(np.float64) / _NORM**2, -1.0, 1.0)))


def verify_pair(matches: IntArray, a: KeyframeFeatures, b: KeyframeFeatures) -> IntArray:
    """The matches (M,2) that one essential (a lens unknown: fundamental) matrix explains."""
    import cv2

    none = matches[:0]
    if a.calibrated and b.calibrated:
        rays = np.abs(np.column_stack([a.rays[matches[:, 0]], b.rays[matches[:, 1]]]))
        matches = matches[(rays < _MAX_TANGENT).all(axis=1)]  # NaN is not
    if len(matches) < MIN_INLIERS:
        return none
    first, second = a.rays[matches[:, 0]], b.rays[matches[:, 1]]
    method = cv2.USAC_ACCURATE
    try:
        if a.calibrated and b.calibrated:
            limit = 0.5 * (a.error + b.error)
            _, kept = cv2.findEssentialMat(first, second, np.eye(3), method, _CONFIDENCE, limit, _MAX_TRIALS)
        else:
            # A known lens beside an unknown one: its undistorted image, in pixels.
            first, second = first * (_pixel_error(a) / a.error), second * (_pixel_error(b) / b.error)
            limit = 0.5 * (_pixel_error(a) + _pixel_error(b))
            _, kept = cv2.findFundamentalMat(first, second, method, limit, _CONFIDENCE, _MAX_TRIALS)
    except cv2.error as error:
        # Where no sample gives a model, OpenCV's local optimisation fails an assertion instead of saying so.
        if error.code != _CV_ASSERTION_FAILED:
            raise
        return none
    return none if kept is None else matches[kept.ravel().astype(bool)]


def _pixel_error(view: KeyframeFeatures) -> float:
    return _MAX_ERROR_PX if view.calibrated else view.error


def _write_matches(
    database: pycolmap.Database, a: int, b: int, matches: IntArray, *, calibrated: bool
) -> None:
    import pycolmap

    geometry: Any = pycolmap.TwoViewGeometry()
    geometry.config = _CALIBRATED if calibrated else _UNCALIBRATED
    geometry.inlier_matches = matches.astype(np.uint32)
    database.write_two_view_geometry(a, b, geometry)
