"""Match pairs of keyframes and verify the matches: one matrix product and one robust fit for each pair."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, Pair, read_image_ids
from bodycap_batch.mapping.matching.descriptors import (
    DESCRIPTOR_NORM,
    MAX_MATCH_ANGLE_RAD,
    MAX_RATIO,
    ByteDescriptors,
    FloatDescriptors,
)
from bodycap_batch.mapping.matching.rotation_graph import PairRotation, find_contradicted_pairs
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.model.optical_flow import pixel_scale

if TYPE_CHECKING:
    import pycolmap

MIN_INLIERS = 15
"""Minimum number of matches of a verified pair. COLMAP's default: its mapper ignores pairs with fewer
matches."""
_MAX_ERROR_PX = 4.0
"""Maximum epipolar error of an inlier, in px of an image with a long side of 640 px. COLMAP's default."""
_MAX_TRIALS = 400
"""Maximum number of random samples of a robust fit. Each sample has five matches. If one match in three is
correct, 1.6 of 400 samples have no wrong match on average (0.33^5 x 400). COLMAP's maximum of 10,000 samples
would cost much time for pairs that show different places. Evidence: docs/decisions/mapping.md."""
_CONFIDENCE = 0.999
"""Probability at which a robust fit ends early: the probability that at least one sample without a wrong
match was drawn. OpenCV's default."""
_MIN_TRIALS = 10
"""Minimum number of random samples of a robust fit. Evidence: docs/decisions/mapping.md."""
_TRIALS_SURPLUS = 4
"""Factor on the number of samples that a pair needs at the least ratio of correct matches. A sample without a
wrong match can still give an inaccurate geometry, because its matches are noisy. Evidence:
docs/decisions/mapping.md."""
_SAMPLE_CALIBRATED = 5
"""Number of matches in a sample from which an essential matrix is computed."""
_SAMPLE_UNCALIBRATED = 7
"""Number of matches in a sample from which a fundamental matrix is computed."""
_MAX_TANGENT = 2.5
"""Maximum absolute value of x and of y of a ray with z = 1. The value 2.5 corresponds to an angle of 68
degrees from the optical axis. At larger angles, x and y grow too fast with the angle to measure errors."""
_PAIRS_PER_TRANSACTION = 512
"""Number of pairs that are matched between two writes to the database. A larger number needs more memory, and
more work is lost in a crash. The matches do not depend on this number."""
_CV_ASSERTION_FAILED = -215
"""OpenCV's error code for a failed assertion."""


@dataclass(frozen=True, slots=True)
class KeyframeFeatures:
    """The features of one keyframe, in the form that matching needs.

    Attributes:
        descriptors: (N,128) root-normalised descriptors as bytes.
        rays: (N,2) positions of the features. For a calibrated camera: undistorted image points at depth 1.
            For an uncalibrated camera: detected positions, px (OpenCV's origin).
        error: Maximum epipolar error of an inlier, in the unit of `rays`.
        calibrated: True if the camera is calibrated; False if its intrinsics are only a first estimate.
    """

    descriptors: ByteDescriptors
    rays: FloatArray
    error: float
    calibrated: bool

    @staticmethod
    def of(
        px: FloatArray,
        descriptors: ByteDescriptors,
        intrinsics: CameraIntrinsics,
        max_error_px: float = _MAX_ERROR_PX,
    ) -> KeyframeFeatures:
        """Return the features of a keyframe.

        Args:
            px: (N,2) positions of the features, px.
            descriptors: (N,128) root-normalised descriptors as bytes.
            intrinsics: Intrinsics of the keyframe's camera.
            max_error_px: Maximum epipolar error of an inlier, px of an image with a long side of 640 px.
        """
        camera, calibrated = intrinsics.camera, intrinsics.calibrated
        error = max_error_px * pixel_scale(camera.width_px, camera.height_px)
        return KeyframeFeatures(
            descriptors=descriptors,
            rays=camera.unproject(px) if calibrated else px - CV2_PIXEL_OFFSET_PX,
            error=error / camera.focal_px if calibrated else error,
            calibrated=calibrated,
        )


def match_pairs(
    workspace: Path,
    pairs: Sequence[Pair],
    intrinsics: Mapping[str, CameraIntrinsics],
    context: StageContext,
) -> dict[Pair, int]:
    """Match and verify pairs of keyframes, and write the verified matches to the database.

    Args:
        workspace: Folder of the database.
        pairs: Pairs of keyframes to match.
        intrinsics: Intrinsics by camera name.
        context: Threads, progress, cancellation.

    Returns:
        Number of verified matches of each verified pair. Pairs that the rotation of the videos contradicts
        are not verified (`find_contradicted_pairs`). Those of earlier calls are removed, too.

    Source: Lowe, IJCV 2004 (ratio test); Barath et al., "MAGSAC++", CVPR 2020 and Raguram et al., "USAC",
        PAMI 2013, as implemented in OpenCV, for the robust fit.
    """
    import pycolmap

    verified: dict[Pair, int] = {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        features = _read_features(database, ids, {ref for pair in pairs for ref in pair}, intrinsics)
        for done in range(0, len(pairs), _PAIRS_PER_TRANSACTION):
            context.progress(done, len(pairs), "pairs")
            block = pairs[done : done + _PAIRS_PER_TRANSACTION]
            with pycolmap.DatabaseTransaction(database):
                for (a, b), found in zip(block, _match_block(block, features, context), strict=True):
                    if len(found.matches) >= MIN_INLIERS:
                        calibrated = features[a].calibrated and features[b].calibrated
                        _write_matches(database, ids[a], ids[b], found, calibrated=calibrated)
                        verified[a, b] = len(found.matches)
        context.progress(len(pairs), len(pairs), "pairs")
        contradicted = _remove_contradicted(database, ids, intrinsics) if verified else set[Pair]()
    return {pair: count for pair, count in verified.items() if pair not in contradicted}


def _remove_contradicted(
    database: pycolmap.Database, ids: Mapping[ImageRef, int], intrinsics: Mapping[str, CameraIntrinsics]
) -> set[Pair]:
    """Remove the verified pairs that the rotation of the videos contradicts, and return them."""
    import pycolmap

    if not is_on(Mechanism.PAIR_ROTATIONS):
        return set()
    found = find_contradicted_pairs(read_pair_rotations(database), intrinsics)
    with pycolmap.DatabaseTransaction(database):
        for first, second in sorted(found):
            database.delete_two_view_geometry(ids[first], ids[second])
    record_act(Mechanism.PAIR_ROTATIONS, len(found))
    return found


def read_pair_rotations(database: pycolmap.Database) -> list[PairRotation]:
    """Return the rotations of the verified pairs of calibrated cameras."""
    import pycolmap

    ref_of = {number: ref for ref, number in read_image_ids(database).items()}
    out = []
    for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
        if geometry.cam2_from_cam1 is not None:
            first, second = (ref_of[number] for number in pycolmap.pair_id_to_image_pair(pair_id))
            rotation = geometry.cam2_from_cam1.rotation.matrix()
            out.append(PairRotation((first, second), rotation))
    return out


def _read_features(
    database: pycolmap.Database,
    ids: Mapping[ImageRef, int],
    refs: set[ImageRef],
    intrinsics: Mapping[str, CameraIntrinsics],
) -> dict[ImageRef, KeyframeFeatures]:
    """Read the features of the keyframes `refs` from the database."""
    return {
        ref: KeyframeFeatures.of(
            np.asarray(database.read_keypoints(ids[ref]), dtype=np.float64)[:, :2],
            np.asarray(database.read_descriptors(ids[ref]).data),
            intrinsics[ref.camera],
        )
        for ref in sorted(refs)
    }


def _match_block(
    pairs: Sequence[Pair], features: Mapping[ImageRef, KeyframeFeatures], context: StageContext
) -> Iterator[VerifiedMatches]:
    """Match and verify pairs in several threads, and yield the verified matches in the order of `pairs`."""
    parts = [pairs[start :: context.threads] for start in range(context.threads)]

    def work(part: Sequence[Pair]) -> list[VerifiedMatches]:
        out, last, first = list[VerifiedMatches](), None, np.zeros((0, 128), np.float32)
        for a, b in part:
            context.check_cancelled()
            if a != last:
                last, first = a, features[a].descriptors.astype(np.float32)
            matches = find_mutual_matches(first, features[b].descriptors.astype(np.float32))
            out.append(verify_pair(matches, features[a], features[b]))
        return out

    with ThreadPoolExecutor(context.threads) as pool:
        done = [iter(result) for result in pool.map(work, parts)]
    for number in range(len(pairs)):
        yield next(done[number % context.threads])


def find_mutual_matches(first: FloatDescriptors, second: FloatDescriptors) -> IntArray:
    """Return the matches (K,2) of two keyframes, as indices of their features.

    Two features match if each is the nearest feature of the other one and they pass the ratio test.

    Args:
        first: (N,128) root-normalised descriptors of the first keyframe.
        second: (M,128) root-normalised descriptors of the second keyframe.
    """
    if len(first) < MIN_INLIERS or len(second) < MIN_INLIERS:
        return np.zeros((0, 2), dtype=np.int64)
    products = first @ second.T
    row = np.arange(len(first))
    nearest = products.argmax(axis=1)
    best = products[row, nearest]
    mutual = best == products.max(axis=0)[nearest]
    near = np.flatnonzero(mutual & (best > np.cos(MAX_MATCH_ANGLE_RAD) * DESCRIPTOR_NORM**2))
    products[near, nearest[near]] = -1.0
    second_best = products[near].max(axis=1, initial=-1.0)
    near = near[_angle_rad(best[near]) < MAX_RATIO * _angle_rad(second_best)]
    # Two features of `first` can be equally near to one feature of `second`. Then only the match of the
    # feature with the smaller index is kept.
    _, once = np.unique(nearest[near], return_index=True)
    near = near[np.sort(once)]
    return np.column_stack([near, nearest[near]])


def _angle_rad(products: npt.NDArray[np.float32]) -> FloatArray:
    """Return the angles (radians) between descriptors, given the descriptors' scalar products."""
    return np.asarray(np.arccos(np.clip(products.astype(np.float64) / DESCRIPTOR_NORM**2, -1.0, 1.0)))


@dataclass(frozen=True, slots=True)
class VerifiedMatches:
    """The matches of a pair that agree with one two-view geometry.

    Attributes:
        matches: (M,2) indices of the features.
        b_from_a: (3,4) rotation and direction of the translation from camera a to camera b; None if a camera
            is not calibrated, or without matches.
    """

    matches: IntArray
    b_from_a: FloatArray | None = None


def verify_pair(matches: IntArray, a: KeyframeFeatures, b: KeyframeFeatures) -> VerifiedMatches:
    """Return the subset of the matches (K,2) that agrees with one two-view geometry.

    The two-view geometry is an essential matrix if both cameras are calibrated, else a fundamental matrix.
    """
    import cv2

    none = VerifiedMatches(matches[:0])
    if a.calibrated and b.calibrated:
        rays = np.abs(np.column_stack([a.rays[matches[:, 0]], b.rays[matches[:, 1]]]))
        matches = matches[(rays < _MAX_TANGENT).all(axis=1)]  # The comparison is False for NaN.
    if len(matches) < MIN_INLIERS:
        return none
    first, second = a.rays[matches[:, 0]], b.rays[matches[:, 1]]
    method = cv2.USAC_ACCURATE
    try:
        if a.calibrated and b.calibrated:
            limit = 0.5 * (a.error + b.error)
            trials = max_trials(len(matches), _SAMPLE_CALIBRATED)
            essential, kept = cv2.findEssentialMat(
                first, second, np.eye(3), method, _CONFIDENCE, limit, trials
            )
        else:
            # If only one camera is calibrated, its rays are converted to undistorted pixels, because the
            # positions in the other keyframe are pixels too.
            first, second = first * (_error_px(a) / a.error), second * (_error_px(b) / b.error)
            limit = 0.5 * (_error_px(a) + _error_px(b))
            trials = max_trials(len(matches), _SAMPLE_UNCALIBRATED)
            essential = None
            _, kept = cv2.findFundamentalMat(first, second, method, limit, _CONFIDENCE, trials)
    except cv2.error as error:
        # If no sample gives a two-view geometry, an assertion in OpenCV fails. Then no match is verified.
        # Other errors are raised.
        if error.code != _CV_ASSERTION_FAILED:
            raise
        return none
    if kept is None:
        return none
    inside = kept.ravel().astype(bool)
    if essential is None or inside.sum() < MIN_INLIERS:
        return VerifiedMatches(matches[inside])
    _, rotation, direction, _ = cv2.recoverPose(essential, first[inside], second[inside], np.eye(3))
    return VerifiedMatches(matches[inside], np.hstack([rotation, direction]))


def max_trials(count: int, sample: int) -> int:
    """Return the maximum number of random samples of a robust fit, at most `_MAX_TRIALS`.

    A pair is verified only if at least `MIN_INLIERS` of its matches agree. So the ratio of correct matches of
    a pair with few matches is high, or the pair is rejected. With few samples, a wrong pair is rejected
    early.

    Args:
        count: Number of matches, at least `MIN_INLIERS`.
        sample: Number of matches in a sample.
    """
    all_correct = min((MIN_INLIERS / count) ** sample, _CONFIDENCE)
    needed = math.log(1.0 - _CONFIDENCE) / math.log(1.0 - all_correct)
    return min(_MAX_TRIALS, max(_MIN_TRIALS, math.ceil(_TRIALS_SURPLUS * needed)))


def _error_px(features: KeyframeFeatures) -> float:
    """Return the maximum epipolar error (px) of an inlier of a keyframe.

    The unit for an uncalibrated camera is a pixel of the keyframe. The unit for a calibrated camera is a
    pixel of an image with a long side of 640 px.
    """
    return _MAX_ERROR_PX if features.calibrated else features.error


def _write_matches(
    database: pycolmap.Database, a: int, b: int, found: VerifiedMatches, *, calibrated: bool
) -> None:
    """Write the verified matches of the images `a` and `b` to the database."""
    import pycolmap

    configuration = pycolmap.TwoViewGeometryConfiguration
    geometry: Any = pycolmap.TwoViewGeometry()
    geometry.config = configuration.CALIBRATED if calibrated else configuration.UNCALIBRATED
    if found.b_from_a is not None:
        geometry.cam2_from_cam1 = pycolmap.Rigid3d(found.b_from_a)
    geometry.inlier_matches = found.matches.astype(np.uint32)
    database.write_two_view_geometry(a, b, geometry)
