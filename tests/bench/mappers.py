"""Compare the incremental and the global mapper on the same features and verified pairs.

``python -m tests.bench mappers FOLDER [FOLDER ...] --features 512 1024``: captures of videos with global
shutters, calibrations and true paths. The global mapper is COLMAP's. It gets only pairs whose relative pose
is unambiguous: no other relative pose of the pair, from its essential matrix or its homography, explains the
matches nearly as well. Printed for each mapper, as it was built and after the repair: keyframes, error under
the least-squares similarity, keyframes that are more than 10 cm off under the similarity that fits most of
them, and processor time.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.config.options import KeyframeOptions, MapOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping.initial_models import reconstruct_with_intrinsics
from bodycap_batch.mapping.inputs import (
    calibrated_camera_ids,
    frame_times_ns,
    intrinsics_of,
    make_mapping_context,
)
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    Pair,
    add_camera,
    read_camera_ids,
    read_image_ids,
)
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.mapping.matching.pair_selection import PairGenerator, match_keyframes
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.results import finalise_models
from bodycap_batch.mapping.validation.repair import remove_without_adjustment, repair_model
from bodycap_batch.model.geometry import align_points, skew
from bodycap_batch.model.optical_flow import unit_directions
from tests.bench.bare import MISPLACED_M, robust_alignment

_MIN_MATCHES = 20
"""Minimum number of matches of a pair for the global mapper. Evidence: none."""
_MIN_MARGIN = 10.0
"""Minimum difference of the costs of the two best relative poses of a pair. The unit is that of a log
likelihood. Evidence: docs/decisions/mapping.md."""
_SAME_POSE_DEG = 2.0
"""Maximum angle between the orientations of two relative poses that count as one. Evidence: none."""
_MIN_FRONT = 0.5
"""Minimum fraction of matches in front of both cameras. Evidence: none."""
_INLIER_PX = 4.0
"""Maximum epipolar error of a match, px. COLMAP's default."""
_REFINED_PX = 2.0
"""Maximum epipolar error of a match from which a relative pose is refined, px. Evidence: none."""
_BEHIND_COST = 1e6
"""Cost of a relative pose that has most matches behind a camera: larger than any other."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A workspace with features and verified pairs.

    Attributes:
        capture: All cameras.
        refs: All keyframes.
        options: Options of the map.
        context: Context of the mapping run.
        tried: Pairs that were matched.
        truth: True paths of the cameras.
    """

    capture: Capture
    refs: list[ImageRef]
    options: MapOptions
    context: MappingContext
    tried: set[Pair]
    truth: Mapping[str, TimedPoses]


def prepare(folder: Path, features: int, work: Path) -> Prepared:
    """Select keyframes, extract features and match pairs, as the program does."""
    import pycolmap

    stage, workspace = StageContext(work_dir=work, threads=2), work / "workspace"
    workspace.mkdir(parents=True)
    capture, options = open_capture(load_job(folder).capture, 2), MapOptions(features=features)
    selections = [select_keyframes(camera, KeyframeOptions(), stage) for camera in capture.cameras]
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = {item.camera: add_camera(database, capture.camera(item.camera)) for item in selections}
    keyframes = [
        CameraKeyframes(capture.camera(item.camera), ids[item.camera], np.asarray(item.frames))
        for item in selections
    ]
    add_keyframes(workspace, keyframes, options, stage)
    calibrated = calibrated_camera_ids(capture, read_camera_ids(workspace))
    refs = [ImageRef(item.camera, int(frame)) for item in selections for frame in item.frames]
    generator = PairGenerator(workspace, refs, frame_times_ns(capture), options, stage)
    tried, _ = match_keyframes(generator, workspace, intrinsics_of(capture), stage)
    return Prepared(
        capture=capture,
        refs=refs,
        options=options,
        context=make_mapping_context(workspace, capture, options, calibrated, stage, SKELETAL_ABOVE),
        tried=tried,
        truth={camera.name: read_tum(folder / "gt" / f"{camera.name}.tum") for camera in capture.cameras},
    )


def write_unambiguous_pairs(prepared: Prepared, target: Path) -> tuple[int, int]:
    """Write a copy of the database with the pairs whose relative pose is unambiguous.

    Returns:
        Number of all verified pairs, and of the written ones.
    """
    import pycolmap

    shutil.copy(prepared.context.workspace / DATABASE_NAME, target)
    written = 0
    with pycolmap.Database.open(str(target)) as database:
        refs = {number: ref for ref, number in read_image_ids(database).items()}
        cameras = {ref.camera: prepared.capture.camera(ref.camera).camera for ref in refs.values()}
        px = {number: np.asarray(database.read_keypoints(number))[:, :2] for number in refs}
        rays = {
            number: unit_directions(cameras[ref.camera].unproject(px[number])) for number, ref in refs.items()
        }
        pairs = list(zip(*database.read_two_view_geometries(), strict=True))
        database.clear_two_view_geometries()
        with pycolmap.DatabaseTransaction(database):
            for pair, geometry in pairs:
                first, second = map(int, pycolmap.pair_id_to_image_pair(pair))
                focal_px = cameras[refs[first].camera].focal_px
                matches = np.asarray(geometry.inlier_matches, dtype=np.int64)
                a, b = rays[first][matches[:, 0]], rays[second][matches[:, 1]]
                seen = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
                pose = unambiguous_pose(a[seen], b[seen], focal_px)
                if pose is None:
                    continue
                fits = focal_px * np.abs(sampson(pose, a[seen], b[seen])) < _INLIER_PX
                found: Any = pycolmap.TwoViewGeometry()
                found.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                found.E, found.cam2_from_cam1 = essential(pose), pycolmap.Rigid3d(pose)
                found.inlier_matches = matches[seen][fits].astype(np.uint32)
                if fits.sum() >= _MIN_MATCHES:
                    database.write_two_view_geometry(first, second, found)
                    written += 1
    return len(pairs), written


def essential(pose: FloatArray) -> FloatArray:
    """Return the essential matrix (3,3) of a relative pose (3,4)."""
    return np.asarray(skew(pose[:, 3]) @ pose[:, :3])


def sampson(pose: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the Sampson errors (N,) of matches between rays (N,3), as tangents."""
    first, second = first / first[:, 2:], second / second[:, 2:]
    matrix = essential(pose)
    lines, other = first @ matrix.T, second @ matrix
    norm = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (other[:, :2] ** 2).sum(axis=1))
    return np.asarray((second * lines).sum(axis=1) / np.maximum(norm, 1e-12))


def front_share(pose: FloatArray, first: FloatArray, second: FloatArray) -> float:
    """Return the fraction of matches whose point lies in front of both cameras."""
    turned, shift = first @ pose[:, :3].T, pose[:, 3]
    cosine, along, other = (turned * second).sum(axis=1), turned @ shift, second @ shift
    return float(((cosine * other - along > 0) & (other - cosine * along > 0)).mean())


def unambiguous_pose(first: FloatArray, second: FloatArray, focal_px: float) -> FloatArray | None:
    """Return the relative pose (3,4) of matched rays (N,3); None if another one fits nearly as well."""
    if len(first) < _MIN_MATCHES:
        return None
    scored = sorted(
        (_refined(pose, first, second, focal_px) for pose in _hypotheses(first, second, focal_px)),
        key=lambda item: item[0],
    )
    if not scored or scored[0][0] >= _BEHIND_COST:
        return None
    cost, best = scored[0]
    for other_cost, other in scored[1:]:
        cosine = (np.trace(best[:, :3].T @ other[:, :3]) - 1.0) / 2.0
        differs = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))) > _SAME_POSE_DEG
        if differs and other_cost - cost < _MIN_MARGIN:
            return None
    return best


def _hypotheses(first: FloatArray, second: FloatArray, focal_px: float) -> list[FloatArray]:
    """Return relative poses (3,4) from the essential matrix and the homography of matched rays (N,3)."""
    import cv2

    a, b = (rays[:, :2] / rays[:, 2:] for rays in (first, second))
    limit = _INLIER_PX / focal_px
    poses = []
    matrix, _ = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_ACCURATE, 0.999, limit, 400)
    if matrix is not None and matrix.shape == (3, 3):
        one, two, shift = cv2.decomposeEssentialMat(matrix)
        poses += [np.column_stack([turn, sign * shift]) for turn in (one, two) for sign in (-1.0, 1.0)]
        poses = sorted(poses, key=lambda pose: -front_share(pose, first, second))[:1]
    homography, _ = cv2.findHomography(a, b, cv2.USAC_ACCURATE, limit, maxIters=400, confidence=0.999)
    if homography is not None:
        _, turns, shifts, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
        planar = [
            np.column_stack([turn, shift / np.linalg.norm(shift)])
            for turn, shift in zip(turns, shifts, strict=True)
            if np.linalg.norm(shift) > 0.0
        ]
        poses += sorted(planar, key=lambda pose: -front_share(pose, first, second))[:2]
    return poses


def _refined(
    pose: FloatArray, first: FloatArray, second: FloatArray, focal_px: float
) -> tuple[float, FloatArray]:
    """Return the cost of a relative pose after refinement, and the refined pose."""
    import pycolmap

    for _ in range(2):
        error_px = focal_px * np.abs(sampson(pose, first, second))
        fits = error_px < max(_REFINED_PX, 1.5 * float(np.median(error_px)))
        found = pycolmap.refine_relative_pose(pycolmap.Rigid3d(pose), first, second, fits)
        if found is None:
            break
        pose = found["cam2_from_cam1"].matrix()
        pose[:, 3] /= np.linalg.norm(pose[:, 3])
    mirrored = np.column_stack([pose[:, :3], -pose[:, 3]])
    pose = max(pose, mirrored, key=lambda each: front_share(each, first, second))
    cost = float(np.log1p((focal_px * sampson(pose, first, second)) ** 2).sum())
    behind = front_share(pose, first, second) < _MIN_FRONT
    return cost + (_BEHIND_COST if behind else 0.0), pose


def reconstruct_globally(database: Path, work: Path, seed: int) -> list[Any]:
    """Return the models of COLMAP's global mapper with constant intrinsics, largest first."""
    import pycolmap

    options: Any = pycolmap.GlobalPipelineOptions()
    parts = (options, options.mapper, options.mapper.rotation_averaging, options.mapper.global_positioning)
    for part in (*parts, options.mapper.retriangulation):
        part.random_seed = seed
    options.num_threads = options.mapper.num_threads = 1
    options.decompose_relative_pose = False
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = False
    options.mapper.retriangulation.max_extra_param = 1e3
    work.mkdir(parents=True)
    found = pycolmap.global_mapping(str(database), str(work), str(work), options)
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


def line_of(model: Any, prepared: Prepared) -> str:
    """Return the number and the errors of the keyframes of a model as text."""
    refs = {int(number): ImageRef.parse(model.image(number).name) for number in model.reg_image_ids()}
    frames: dict[str, list[tuple[int, FloatArray]]] = {}
    for number, ref in sorted(refs.items()):
        frames.setdefault(ref.camera, []).append((ref.frame, model.image(number).projection_center()))
    matched = {
        name: (
            np.array([frame for frame, _ in rows]),
            np.array([centre for _, centre in rows]),
            prepared.truth[name].world_from_cam[[frame for frame, _ in rows], :3, 3],
        )
        for name, rows in frames.items()
    }
    mine, true = (np.concatenate([item[side] for item in matched.values()]) for side in (1, 2))
    error = np.linalg.norm(align_points(mine, true).apply(mine) - true, axis=1)
    fitted = np.linalg.norm(robust_alignment(matched).apply(mine) - true, axis=1)
    return (
        f"{len(mine)}/{len(prepared.refs)} keyframes, {100 * np.sqrt((error**2).mean()):.2f} cm, "
        f"worst {100 * error.max():.1f}; median {100 * np.median(fitted):.2f}, "
        f"{int((fitted > MISPLACED_M).sum())} more than {100 * MISPLACED_M:.0f} cm off"
    )


def measure(folder: Path, features: int, work: Path) -> None:
    """Print the figures of both mappers on one capture."""
    prepared = prepare(folder, features, work)
    name = f"{folder.name}, {features} features"
    found = list[tuple[str, list[Any], float]]()
    started = time.process_time()
    uncalibrated: dict[int, str] = {}
    models, _ = reconstruct_with_intrinsics(
        prepared.context, prepared.options, uncalibrated, len(prepared.refs)
    )
    found.append(("incremental", models, time.process_time() - started))
    started = time.process_time()
    pairs, written = write_unambiguous_pairs(prepared, work / "unambiguous.db")
    _write_line(f"{name}: {written} of {pairs} pairs have an unambiguous relative pose")
    models = reconstruct_globally(work / "unambiguous.db", work / "global", prepared.options.seed)
    found.append(("global", models, time.process_time() - started))
    database, before = prepared.context.workspace / DATABASE_NAME, work / "before_repair.db"
    shutil.copy(database, before)
    for mapper, models, seconds in found:
        # The repair of a map adds pairs to the database.
        shutil.copy(before, database)
        if not models:
            _write_line(f"{name}, {mapper}: no model, {seconds:.0f} CPU s")
            continue
        _write_line(f"{name}, {mapper}: {line_of(models[0], prepared)}, {seconds:.0f} CPU s")
        started = time.process_time()
        models[0], _ = repair_model(models[0], set(prepared.tried), prepared.context, prepared.refs)
        finalise_models(models, prepared.context, [None] * len(models))
        last, _, _ = remove_without_adjustment(models[0], prepared.context)
        added = time.process_time() - started
        _write_line(f"{name}, {mapper}, repaired: {line_of(last, prepared)}, {added:.0f} more CPU s")


def main(arguments: Sequence[str]) -> int:
    """Print the figures of both mappers on each capture."""
    parser = argparse.ArgumentParser(prog="make bench ARGS='mappers …'", description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+", help="folders of captures with truth")
    parser.add_argument("--features", type=int, nargs="+", default=[512], help="numbers of features (512)")
    options = parser.parse_args(arguments)
    for capture in options.captures:
        for features in options.features:
            with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as work:
                measure(capture.resolve(), features, Path(work))
    return 0


def _write_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
