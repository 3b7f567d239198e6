"""Misregistered keyframes are found through inconsistent pairs, and repaired."""

from __future__ import annotations

import copy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.mapping import initial_models
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.initial_models import reconstruct_with_intrinsics
from bodycap_batch.mapping.intrinsics import intrinsics_check
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    read_image_ids,
)
from bodycap_batch.mapping.matching.pair_matching import find_mutual_matches, match_pairs
from bodycap_batch.mapping.re_registration import re_register_images
from bodycap_batch.mapping.reconstruction.bundle_adjustment import (
    adjust_and_filter,
    adjust_robustly,
    sub_model,
)
from bodycap_batch.mapping.reconstruction.incremental_mapper import _MapperRun, register_images
from bodycap_batch.mapping.reconstruction.initial_pair import find_user_pair, rank_initial_pairs
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct
from bodycap_batch.mapping.results import finalise_models
from bodycap_batch.mapping.validation.epipolar_consistency import (
    PairConsistency,
    evaluate_pairs,
    find_misregistered_images,
)
from bodycap_batch.mapping.validation.repair import remove_without_adjustment, repair_model
from bodycap_batch.mapping.validation.second_registration import confirm_images
from bodycap_batch.mapping.validation.track_agreement import (
    PairAgreement,
    evaluate_agreement,
    find_misplaced_images,
    image_sequences,
)
from bodycap_batch.mapping.validation.transient_points import remove_transient_points
from bodycap_batch.mapping.validation.wearer_points import remove_points_on_wearer
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import Similarity, align_points, invert
from tests.misplaced import misplace
from tests.unit.mapping.wall import KEYFRAMES, LENS, write_wall

_INTRINSICS = {"cam": CameraIntrinsics(LENS, calibrated=True)}
_NUMBERS = {"cam": np.arange(30, 30 + KEYFRAMES)}
"""Frame numbers of the whole video, also before start_s: users name the frames that they see."""
_MOVED = (6, 7, 8)


def test_misregistered_images_are_found_but_not_their_partners() -> None:
    pairs = [PairConsistency(a, b, 100, 1.0) for a in range(10) for b in range(a)]
    assert find_misregistered_images(pairs) == set()
    wrong = [
        PairConsistency(x.first, x.second, 100, 0.1 if (x.first in (4, 5)) != (x.second in (4, 5)) else 1.0)
        for x in pairs
    ]
    assert find_misregistered_images(wrong) == {4, 5}


def test_an_island_that_agrees_only_with_itself_is_misplaced() -> None:
    pairs = [PairAgreement(a, b, 60, 57) for a in range(8) for b in range(a)]
    pairs += [PairAgreement(a, b, 60, 57) for a in range(8, 11) for b in range(8, a)]
    assert find_misplaced_images([*pairs, PairAgreement(7, 8, 40, 36)], [range(11)]) == set()
    weak = [*pairs, PairAgreement(7, 8, 12, 12), PairAgreement(6, 8, 12, 12)]
    assert find_misplaced_images(weak, [range(11)]) == {8, 9, 10}
    assert find_misplaced_images(pairs, [range(12)]) == {8, 9, 10, 11}


def test_a_block_that_drifts_away_is_misplaced_as_a_whole() -> None:
    drifting = range(20, 28)

    def pair(a: int, b: int) -> PairAgreement:
        # Successive images agree, also at both ends of the block. The block contradicts all other images.
        wrong = (a in drifting) != (b in drifting) and a - b > 1 and b != 28
        return PairAgreement(a, b, 20, 4 if wrong else 19)

    pairs = [pair(a, b) for a in range(40) for b in range(max(0, a - 12), a)]
    assert find_misplaced_images(pairs, [range(40)]) == set(drifting)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, FloatArray, MappingContext]:
    folder = tmp_path_factory.mktemp("repair")
    poses = write_wall(folder)
    context = StageContext(work_dir=folder, threads=2)
    refs = [ImageRef("cam", frame) for frame in range(KEYFRAMES)]
    pairs = [(a, b) for a in refs for b in refs if a < b and b.frame - a.frame <= 5]
    assert len(match_pairs(folder, pairs, _INTRINSICS, context)) > 50
    mapping = MappingContext(
        workspace=folder,
        intrinsics=_INTRINSICS,
        mapper_options=lambda: make_mapper_options(MapOptions(), [1], 1.0),
        calibrated_ids=[1],
        stage=context,
        frame_numbers=_NUMBERS,
    )
    models, _ = reconstruct(folder, mapping.mapper_options(), context, KEYFRAMES)
    return models[0], poses, mapping


def _rms(model: Any, poses: FloatArray) -> float:
    """Return the error of the keyframe positions after alignment, in the scene's unit."""
    refs = {ImageRef.parse(model.image(i).name).frame: i for i in model.reg_image_ids()}
    found = np.array([model.image(refs[frame]).projection_center() for frame in sorted(refs)])
    true = invert(poses)[sorted(refs), :3, 3]
    return float(np.sqrt(((align_points(found, true).apply(found) - true) ** 2).sum(axis=1).mean()))


def test_a_complete_map_is_adjusted_once(
    built: tuple[Any, FloatArray, MappingContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, poses, mapping = built
    sizes: list[int] = []
    adjust_all = pycolmap.IncrementalMapper.iterative_global_refinement

    def counted(mapper: Any, *arguments: Any, **options: Any) -> None:
        sizes.append(mapper.reconstruction.num_reg_frames())
        adjust_all(mapper, *arguments, **options)

    monkeypatch.setattr(pycolmap.IncrementalMapper, "iterative_global_refinement", counted)
    settings, model = mapping.mapper_options(), pycolmap.Reconstruction()
    settings.init_image_id1, settings.init_image_id2 = rank_initial_pairs(
        mapping.workspace, mapping.intrinsics
    )[0].ids
    settings.mapper.init_min_tri_angle = 2.0
    assert register_images(mapping.workspace, settings, model, lambda: None)
    assert model.num_reg_images() == KEYFRAMES
    assert _rms(model, poses) < 0.01
    assert sizes[-1] == KEYFRAMES
    # No size occurs twice: nothing is adjusted again if nothing was added.
    assert len(set(sizes)) == len(sizes)


def test_an_empty_map_without_an_initial_pair_is_no_bug(tmp_path: Path) -> None:
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)):
        pass
    settings = make_mapper_options(MapOptions(), [], 1.0)
    assert not register_images(tmp_path, settings, pycolmap.Reconstruction(), lambda: None)


@pytest.mark.parametrize(
    ("scale", "shift"),
    [(0.3, 0.0), (0.6, 0.0), (1.7, 0.0), (4.0, 0.0), (1.0, 0.1), (1.0, 0.3), (1.0, 0.6)],
)
def test_a_block_of_another_scale_or_place_is_found_and_repaired(
    scale: float, shift: float, built: tuple[Any, FloatArray, MappingContext]
) -> None:
    model, poses, mapping = built
    agreement = evaluate_agreement(mapping.workspace, model)
    assert find_misplaced_images(agreement, image_sequences(model)) == set()
    numbers = {ImageRef.parse(model.image(i).name).frame: int(i) for i in model.reg_image_ids()}
    found = np.array([model.image(numbers[frame]).projection_center() for frame in range(KEYFRAMES)])
    unit = align_points(found, invert(poses)[:, :3, 3]).scale
    block = [numbers[frame] for frame in _MOVED]
    middle = found[list(_MOVED)].mean(axis=0)
    # The shift is given in the scene's unit, in which the wall is 4 away and keyframes are 0.25 apart.
    offset = (1.0 - scale) * middle + np.array([0.0, 0.0, shift / unit])
    wrong = misplace(model, block, Similarity(scale, np.eye(3), offset))
    agreement = evaluate_agreement(mapping.workspace, wrong)
    assert find_misplaced_images(agreement, image_sequences(wrong)) == set(block)
    mended, log = repair_model(wrong, mapping, KEYFRAMES)
    assert log["doubtful"] == [f"cam/{frame:07d}" for frame in _MOVED]
    assert log["cut"] == []
    assert _rms(mended, poses) < 0.01
    assert mended.num_reg_images() == KEYFRAMES


def _with_blurred_block(model: Any, block: list[int]) -> Any:
    """Return a copy in which only every third feature of the images `block` still observes its point."""
    out = copy.deepcopy(model)
    for image_id in block:
        for number, feature in enumerate(out.image(image_id).get_observation_point2D_idxs()):
            if number % 3 and out.image(image_id).point2D(feature).has_point3D():
                out.delete_observation(image_id, feature)
    return out


def test_a_correct_block_with_many_wrong_features_is_kept(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, poses, mapping = built
    numbers = {ImageRef.parse(model.image(i).name).frame: int(i) for i in model.reg_image_ids()}
    block = [numbers[frame] for frame in _MOVED]
    blurred = _with_blurred_block(model, block)
    agreement = evaluate_agreement(mapping.workspace, blurred)
    sequences = image_sequences(blurred)
    assert find_misplaced_images(agreement, sequences) == set(block)
    assert confirm_images(mapping.workspace, blurred, block, sequences, 8.0) == set(block)
    assert confirm_images(mapping.workspace, blurred, block[:1], sequences, 8.0) == set()
    kept, removed, _ = remove_without_adjustment(blurred, mapping)
    assert removed == []
    assert _rms(kept, poses) < 0.01


@pytest.mark.parametrize(("scale", "shift"), [(0.3, 0.0), (1.7, 0.0), (4.0, 0.0), (1.0, 0.1), (1.0, 0.6)])
def test_a_misplaced_block_is_not_confirmed(
    scale: float, shift: float, built: tuple[Any, FloatArray, MappingContext]
) -> None:
    model, _, mapping = built
    numbers = {ImageRef.parse(model.image(i).name).frame: int(i) for i in model.reg_image_ids()}
    found = np.array([model.image(numbers[frame]).projection_center() for frame in range(KEYFRAMES)])
    block = [numbers[frame] for frame in _MOVED]
    # Scaled about the keyframe before the block, each keyframe of the block moves.
    start = found[_MOVED[0] - 1]
    offset = (1.0 - scale) * start + np.array([0.0, 0.0, shift * np.linalg.norm(found[1] - found[0]) / 0.25])
    wrong = misplace(model, block, Similarity(scale, np.eye(3), offset))
    confirmed = confirm_images(mapping.workspace, wrong, block, image_sequences(wrong), 8.0)
    assert confirmed == set()


def test_without_points_no_image_is_confirmed(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, _, mapping = built
    empty = copy.deepcopy(model)
    for point in list(empty.point3D_ids()):
        empty.delete_point3D(point)
    sequences = image_sequences(empty)
    assert confirm_images(mapping.workspace, empty, sequences[0][:3], sequences, 8.0) == set()
    # All images of the model are inconsistent: no image is left that determines points.
    assert confirm_images(mapping.workspace, model, sequences[0], sequences, 8.0) == set()
    # The only images that are left see nothing in common with the inconsistent ones.
    assert confirm_images(mapping.workspace, model, sequences[0][:-1], sequences, 8.0) == set()


def _without_points(model: Any) -> Any:
    """Return a copy of a model that keeps its poses only."""
    empty = copy.deepcopy(model)
    for point in list(empty.point3D_ids()):
        empty.delete_point3D(point)
    return empty


def test_a_further_model_without_points_is_dropped(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, poses, mapping = built
    empty = _without_points(model)
    mapping = replace(mapping, times_ns={"cam": np.arange(99) * 10**9})
    models = [copy.deepcopy(model), empty]
    finalise_models(models, mapping, [None, None])
    assert [item.num_reg_images() for item in models] == [KEYFRAMES]
    assert _rms(models[0], poses) < 0.01


@pytest.mark.parametrize(("lens_sigma", "is_refined"), [({}, False), ({1: 0.05}, True)])
def test_the_last_adjustment_refines_a_lens_that_tracks_determined(
    lens_sigma: dict[int, float],
    built: tuple[Any, FloatArray, MappingContext],
    *,
    is_refined: bool,
) -> None:
    model, poses, mapping = built
    mapping = replace(mapping, times_ns={"cam": np.arange(99) * 10**9}, lens_sigma=lens_sigma)
    models = [copy.deepcopy(model), copy.deepcopy(model)]
    finalise_models(models, mapping, [None, None])
    focal_px = [item.camera(1).params[0] for item in models]
    assert bool(focal_px[0] != 420.0) is is_refined
    assert focal_px[1] == focal_px[0], "a camera has one lens in all models"
    assert _rms(models[0], poses) < 0.02


def test_a_lens_that_the_tracks_exclude_is_no_result_of_the_last_adjustment(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, poses, mapping = built
    # The model leads from 10 % less back to 420 px. Tracks with a sigma of 0.1 % exclude that.
    for sigma, focal_px in [(0.001, 378.0), (0.05, 420.0)]:
        exact = replace(mapping, times_ns={"cam": np.arange(99) * 10**9}, lens_sigma={1: sigma})
        models = [copy.deepcopy(model)]
        models[0].camera(1).params = [378.0, *models[0].camera(1).params[1:]]
        finalise_models(models, exact, [None])
        # The model itself determines the focal length to 1 %.
        assert models[0].camera(1).params[0] == pytest.approx(focal_px, rel=0.01)
        assert models[0].num_reg_images() == KEYFRAMES
    assert _rms(models[0], poses) < 0.02


def test_a_map_without_any_point_is_an_error_that_says_so(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, _, mapping = built
    empty = _without_points(model)
    mapping = replace(mapping, times_ns={"cam": np.arange(99) * 10**9})
    with pytest.raises(EstimationError, match="the map is empty"):
        finalise_models([empty], mapping, [None])


def test_conjugate_gradients_give_the_same_map_as_the_direct_solver(
    built: tuple[Any, FloatArray, MappingContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, poses, mapping = built
    centres, solvers = [], []
    create = pycolmap.create_default_bundle_adjuster

    def noted(options: Any, *arguments: Any) -> Any:
        solvers.append(options.ceres.max_num_images_direct_sparse_cpu_solver)
        return create(options, *arguments)

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", noted)
    for limit in (0.0, np.inf):
        monkeypatch.setattr(
            "bodycap_batch.mapping.reconstruction.bundle_adjustment._MAX_DIRECT_TRACK_LENGTH", limit
        )
        adjusted = copy.deepcopy(model)
        adjust_robustly(adjusted, mapping.mapper_options(), mapping.calibrated_ids)
        assert _rms(adjusted, poses) < 0.01
        found = sorted(adjusted.reg_image_ids())
        centres.append(np.array([adjusted.image(image).projection_center() for image in found]))
    assert solvers[0] < KEYFRAMES < solvers[1]
    # Half a pixel makes 5 mm for each point. This is a hundredth of the uncertainty from noise.
    off = align_points(centres[0], centres[1]).apply(centres[0]) - centres[1]
    assert np.linalg.norm(off, axis=1).max() < 1e-4


def test_a_right_map_is_not_changed(built: tuple[Any, FloatArray, MappingContext]) -> None:
    model, poses, mapping = built
    assert model.num_reg_images() == KEYFRAMES
    # Half a pixel at depth 4 and 420 px makes 5 mm for each point; a pose has dozens.
    assert _rms(model, poses) < 0.01
    same, log = repair_model(model, mapping, KEYFRAMES)
    assert same is model
    assert log == {"doubtful": [], "cut": [], "contradicted_share": 0.0}
    assert remove_without_adjustment(model, mapping)[1] == []


def test_a_misregistered_block_is_found_and_repaired(
    built: tuple[Any, FloatArray, MappingContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, poses, mapping = built
    ids = {ref.frame: number for ref, number in _ids(mapping).items()}
    wrong = _with_moved_block(model, ids)
    assert _rms(wrong, poses) > 0.1
    assert find_misregistered_images(evaluate_pairs(mapping.workspace, wrong)) == {
        ids[frame] for frame in _MOVED
    }
    repaired, log = repair_model(wrong, mapping, KEYFRAMES)
    assert log["cut"] == []
    assert repaired.num_reg_images() == KEYFRAMES
    assert _rms(repaired, poses) < 0.01
    # A large map registers none again here, and the mapper may find the same wrong poses again.
    names = [f"cam/{frame:07d}" for frame in _MOVED]
    alone, log = repair_model(wrong, mapping, None)
    assert log["cut"] == names
    module = sys.modules[re_register_images.__module__]
    monkeypatch.setattr(module, "with_new_images", lambda *_, **__: pycolmap.Reconstruction(wrong))
    monkeypatch.setattr(module, "adjust_and_filter", lambda *_: None)
    cut, log = repair_model(wrong, mapping, KEYFRAMES)
    assert log["cut"] == log["doubtful"] == names
    assert log["contradicted_share"] > 0.0
    for left in (alone, cut, remove_without_adjustment(wrong, mapping)[0]):
        assert left.num_reg_images() == KEYFRAMES - len(_MOVED)
        assert _rms(left, poses) < 0.01
    # A registration that loses right keyframes is not taken.
    right = set(wrong.reg_image_ids()) - {
        number for ref, number in _ids(mapping).items() if ref.frame in _MOVED
    }
    fewer = sub_model(wrong, right - set(sorted(right)[-3:]))
    monkeypatch.setattr(module, "with_new_images", lambda *_, **__: fewer)
    kept, log = repair_model(wrong, mapping, KEYFRAMES)
    assert log["cut"] == log["doubtful"] == names
    assert kept.num_reg_images() == KEYFRAMES - len(_MOVED)


def test_keyframes_are_registered_again_against_the_rest(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, poses, mapping = built
    ids = {ref.frame: number for ref, number in _ids(mapping).items()}
    wrong = _with_moved_block(model, ids)
    placed = re_register_images(wrong, {ids[frame] for frame in _MOVED}, mapping, KEYFRAMES)
    assert placed.num_reg_images() == KEYFRAMES
    assert _rms(placed, poses) < 0.01


def test_progress_counts_the_keyframes_that_the_map_has_already(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, _, mapping = built
    reported: list[int] = []
    watching = replace(mapping.stage, progress=lambda done, _total, _what: reported.append(done))
    wrong = _with_moved_block(model, {ref.frame: number for ref, number in _ids(mapping).items()})
    moved = {number for ref, number in _ids(mapping).items() if ref.frame in _MOVED}
    re_register_images(wrong, moved, replace(mapping, stage=watching), KEYFRAMES)
    assert reported == [KEYFRAMES - 2, KEYFRAMES - 1, KEYFRAMES]


@pytest.mark.parametrize(("width", "error_px", "explained"), [(640, 7.0, 1), (640, 9.0, 0), (1280, 14.0, 1)])
def test_the_limit_of_the_epipolar_error_is_scaled_with_the_image(
    width: int, error_px: float, explained: float, tmp_path: Path
) -> None:
    lens = LENS.scaled(width, 3 * width // 4)
    camera = pycolmap.Camera(
        model=lens.model, width=lens.width_px, height=lens.height_px, params=lens.params, camera_id=1
    )
    rng = np.random.default_rng(1)
    points = rng.uniform((-1, -1, 3), (1, 1, 5), (50, 3))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        database.write_camera(camera, use_camera_id=True)
        for number, shift in ((1, 0.0), (2, 0.5)):
            # The second image is displaced along x. An error along y is then the distance to the epipolar
            # line. The Sampson error divides it between both images.
            px = lens.project(points - (shift, 0.0, 0.0))
            px[:, 1] += np.sqrt(2) * error_px * (number - 1)
            image = pycolmap.Image(name=f"cam/{number}", keypoints=px, camera_id=1, image_id=number)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number, px.astype(np.float32))
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-shift, 0.0, 0.0]))
            model.add_image_with_trivial_frame(image, pose)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        geometry.inlier_matches = np.column_stack([np.arange(50), np.arange(50)]).astype(np.uint32)
        database.write_two_view_geometry(1, 2, geometry)
    (pair,) = evaluate_pairs(tmp_path, model)
    assert pair.inlier_ratio == explained


def test_transient_points_are_removed_if_enough_others_remain(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    model, poses, mapping = built
    seen_ns = np.arange(KEYFRAMES) * 300_000_000
    some = pycolmap.Reconstruction(model)
    before = {image: some.image(image).num_points3D for image in some.reg_image_ids()}
    removed = remove_transient_points(some, {"cam": seen_ns})
    assert 0 < removed == model.num_points3D() - some.num_points3D()
    # Points in keyframes more than three apart are static. Others are removed if enough static ones remain.
    for image in some.reg_image_ids():
        assert some.image(image).num_points3D >= min(20, before[image])
    adjust_and_filter(some, mapping.mapper_options(), mapping.calibrated_ids)
    assert _rms(some, poses) < 0.01
    assert remove_transient_points(pycolmap.Reconstruction(model), {"cam": seen_ns * 10}) == 0
    # All keyframes at nearly one time: no point is static, so none can be removed.
    assert remove_transient_points(pycolmap.Reconstruction(model), {"cam": seen_ns // 100}) == 0


def _two_cameras(palm: str, depth: float = 0.6) -> pycolmap.Reconstruction:
    """Return a model of 40 points of a room at a depth of 4, and of 60 near points of one of two cameras.

    Args:
        palm: A letter for each image of the palm: it sees the `r`oom, `n`ear points, `b`oth, or `f`ive of
            each. The two images of the torso see the room.
        depth: Depth of the near points. A tenth of the depth of the room is 0.4, a fifth is 0.8.
    """
    rng = np.random.default_rng(3)
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", width=640, height=480, params=LENS.params, camera_id=number)
        )
    room = rng.uniform((-1, -1, 3.8), (1, 1, 4.2), (40, 3))
    near = rng.uniform((-0.1, -0.1, 1.0), (0.1, 0.1, 1.1), (60, 3)) * depth
    points = np.concatenate([room, near])
    seen_by = {"r": range(40), "n": range(40, 100), "b": range(70), "f": range(35, 45)}
    names = [("torso", 0, "r"), ("torso", 1, "r"), *(("palm", *item) for item in enumerate(palm))]
    tracks = [pycolmap.Track() for _ in points]
    for number, (camera, frame, sees) in enumerate(names, start=1):
        seen = list(seen_by[sees])
        shift = np.array([0.02 * number, 0.0, 0.0])
        image = pycolmap.Image(
            name=ImageRef(camera, frame).name,
            keypoints=LENS.project(points[seen] - shift),
            camera_id=1 + (camera == "palm"),
            image_id=number,
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), -shift))
        for keypoint, index in enumerate(seen):
            tracks[index].add_element(number, keypoint)
    for track, point in zip(tracks, points, strict=True):
        if track.length():
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


@pytest.mark.parametrize(
    ("palm", "depth", "left", "points"),
    [
        ("rrnn", 0.6, [0, 1], 40),  # the hand stays at the chest until the end
        ("rbnnr", 0.6, [0, 1, 4], 40),  # when it leaves the chest, nothing connects the keyframes
        (
            "rbnnbr",
            0.6,
            [0, 1, 2, 3, 4, 5],
            100,
        ),  # a table, which is seen together with the room before and after
        ("rbnnbr", 0.3, [0, 1, 4, 5], 40),  # the hand touches something that no other camera sees
        ("rbnnr", 0.9, [0, 1, 2, 3, 4], 100),  # out of reach
        ("rffr", 0.6, [0, 3], 40),  # five points of the room are too few
        ("rrrr", 0.6, [0, 1, 2, 3], 40),
    ],
)
def test_keyframes_of_near_points_are_kept_only_between_keyframes_of_the_room(
    palm: str, depth: float, left: list[int], points: int
) -> None:
    model = _two_cameras(palm, depth)
    before = model.num_points3D()
    assert remove_points_on_wearer(model) == before - points
    assert model.num_points3D() == points
    refs = sorted(ImageRef.parse(model.image(number).name) for number in model.reg_image_ids())
    assert [ref.frame for ref in refs if ref.camera == "palm"] == left
    assert [ref.frame for ref in refs if ref.camera == "torso"] == [0, 1]
    assert remove_points_on_wearer(model) == 0


def test_a_camera_that_shares_no_points_keeps_its_near_points() -> None:
    # Its usual depth is unknown: the near points may be a desk.
    model = _two_cameras("nnnn")
    assert remove_points_on_wearer(model) == 0
    assert model.num_reg_images() == 6


@pytest.mark.parametrize(("share", "gain"), [(0.0, 0.6), (0.25, 1.4)])
def test_outlying_keypoints_do_not_bend_a_robustly_adjusted_map(
    built: tuple[Any, FloatArray, MappingContext], share: float, gain: float
) -> None:
    model, poses, mapping = built
    rng = np.random.default_rng(3)
    squared = pycolmap.Reconstruction(model)
    for image_id in squared.reg_image_ids():
        for point in squared.image(image_id).points2D:
            # By less than the 4 px at which observations are removed.
            if point.has_point3D() and rng.random() < share:
                point.xy = point.xy + rng.uniform(2.2, 3.2) * np.array([1.0, 0.5])
    adjusted = pycolmap.Reconstruction(squared)
    adjust_and_filter(squared, mapping.mapper_options(), mapping.calibrated_ids)
    adjust_robustly(adjusted, mapping.mapper_options(), mapping.calibrated_ids)
    # If all noise is Gaussian, so narrow a loss costs 1.4 times the error of a squared loss.
    assert gain * _rms(adjusted, poses) < _rms(squared, poses)
    assert adjusted.num_points3D() > 0.9 * squared.num_points3D()
    for image_id, image in model.images.items():
        assert adjusted.image(image_id).num_points3D > 0.8 * image.num_points3D


def _with_moved_block(model: Any, ids: dict[int, int]) -> Any:
    wrong = pycolmap.Reconstruction(model)
    shift = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([1.0, 0.6, 0.4]))
    for frame in _MOVED:
        image = wrong.image(ids[frame])
        wrong.frame(image.frame_id).set_cam_from_world(image.camera_id, shift * image.cam_from_world())
    return wrong


def _ids(mapping: MappingContext) -> dict[ImageRef, int]:
    with pycolmap.Database.open(str(mapping.workspace / DATABASE_NAME)) as database:
        return read_image_ids(database)


def test_initial_pairs_with_sideways_movement_rank_first(
    built: tuple[Any, FloatArray, MappingContext],
) -> None:
    _, _, mapping = built
    best = rank_initial_pairs(mapping.workspace, _INTRINSICS)
    steps = [abs(int(a[-7:]) - int(b[-7:])) for a, b in (pair.names for pair in best)]
    # Neighbours 0.25 apart at a distance of 4 from the wall have 3.5 degrees of parallax, five steps over 8.
    assert steps[0] >= 3
    assert best[-1].parallax_rad < best[0].parallax_rad
    assert "parallax" in replace(best[0], parallax_rad=0.001).rejection_reason


def test_keyframes_that_an_initial_pair_does_not_reach_make_another_model(tmp_path: Path) -> None:
    poses = write_wall(tmp_path)
    context = StageContext(work_dir=tmp_path, threads=1)
    halves = [[ImageRef("cam", frame) for frame in half] for half in (range(8), range(8, KEYFRAMES))]
    match_pairs(
        tmp_path, [(a, b) for half in halves for a in half for b in half if a < b], _INTRINSICS, context
    )
    pair = rank_initial_pairs(tmp_path, _INTRINSICS)[0]
    settings = make_mapper_options(MapOptions(), [1], 1.0)
    models, ladder = reconstruct(tmp_path, settings, context, KEYFRAMES, [pair])
    assert ladder == [{**ladder[0], "models": [8, 8], "pair": list(pair.names)}]
    held = [{model.image(number).name for number in model.reg_image_ids()} for model in models]
    assert sorted(map(sorted, held)) == [[ref.name for ref in half] for half in halves]
    assert max(_rms(model, poses) for model in models) < 0.01


def _link_one_way(folder: Path) -> None:
    """Match two halves of the walk; two keyframes of the first observe points of the second only."""
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        ids = {ref.frame: number for ref, number in read_image_ids(database).items()}
        seen = {frame: np.asarray(database.read_descriptors(number).data) for frame, number in ids.items()}
        pairs = [(a, b) for a in range(KEYFRAMES) for b in range(a + 1, min(a + 6, KEYFRAMES))]
        for a, b in [
            pair for pair in pairs if pair[0] >= 8 or pair[1] < 8 or (pair[0] >= 6 and pair[1] <= 10)
        ]:
            matches = find_mutual_matches(seen[a].astype(np.float32), seen[b].astype(np.float32))
            odd = seen[a][matches[:, 0]].astype(int).sum(axis=1) % 2 == 1
            geometry: Any = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches[odd == (b >= 8) if a < 8 else slice(None)].astype(np.uint32)
            database.write_two_view_geometry(ids[a], ids[b], geometry)


def test_an_initial_pair_in_the_unconnected_half_loses_no_keyframes(tmp_path: Path) -> None:
    poses = write_wall(tmp_path)
    _link_one_way(tmp_path)
    context = StageContext(work_dir=tmp_path, threads=1)
    pair = find_user_pair(tmp_path, ("cam:31", "cam:35"), _INTRINSICS, _NUMBERS)
    assert pair is not None
    settings = make_mapper_options(MapOptions(), [1], 1.0)
    models, _ = reconstruct(tmp_path, settings, context, KEYFRAMES, [pair])
    assert [model.num_reg_images() for model in models] == [KEYFRAMES]
    assert _rms(models[0], poses) < 0.01


def test_a_camera_that_joins_without_points_of_the_map_keeps_its_calibration() -> None:
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera(model="PINHOLE", params=LENS.params, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
    _add_unregistered_image(model, camera_id=1, image_id=7)

    class Mapper:
        """Registers one image without points, and refines the intrinsics as COLMAP does."""

        reconstruction = model

        def find_next_images(self, _: object, *, structure_less: bool) -> list[int]:
            return [7] if structure_less else []

        def register_next_structure_less_image(self, _: object, image_id: int) -> bool:
            for camera in model.cameras.values():
                camera.params = [394.0, 411.0, 320.0, 240.0]
            return image_id == 7

    run = _MapperRun(cast("Any", Mapper()), make_mapper_options(MapOptions(), [2], 1.0))
    assert run._register_next() == 7
    assert model.camera(2).params.tolist() == LENS.params.tolist()
    assert model.camera(1).params[0] == 394.0, "an unknown lens is refined"


def test_images_of_a_camera_that_is_in_the_map_do_not_join_without_points() -> None:
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera(model="PINHOLE", params=LENS.params, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
    tried: list[int] = []
    for image_id in (1, 2):
        image = pycolmap.Image(name=f"cam/{image_id}", camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for camera_id, image_id in ((1, 3), (2, 4), (2, 5), (2, 6)):
        _add_unregistered_image(model, camera_id=camera_id, image_id=image_id)

    class Mapper:
        """Registers no image, and notes which were tried without points."""

        reconstruction = model

        def find_next_images(self, _: object, *, structure_less: bool) -> list[int]:
            return [3, 4, 6] if structure_less else []

        def register_next_structure_less_image(self, _: object, image_id: int) -> bool:
            tried.append(image_id)
            return False

    run = _MapperRun(cast("Any", Mapper()), make_mapper_options(MapOptions(), [], 1.0))
    assert run._register_next() is None
    assert tried == [4, 6], "most images of camera 1 are in the map"


def _add_unregistered_image(model: Any, *, camera_id: int, image_id: int) -> None:
    image = pycolmap.Image(name=f"cam/{image_id}", camera_id=camera_id, image_id=image_id)
    model.add_image_with_trivial_frame(image)


def test_colmaps_own_pipeline_registers_no_image_without_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[bool] = []

    def mapping(*arguments: Any, **_: Any) -> dict[int, Any]:
        used.append(arguments[3].structure_less_registration_fallback)
        return {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
    settings = make_mapper_options(MapOptions(), [1], 1.0)
    assert reconstruct(tmp_path, settings, StageContext(work_dir=tmp_path, threads=1), 9)[0] == []
    assert used
    assert not any(used)
    assert settings.structure_less_registration_fallback, "further images may be registered so"


@pytest.mark.slow
def test_the_users_initial_pair_is_used(built: tuple[Any, FloatArray, MappingContext]) -> None:
    _, poses, mapping = built
    pair = find_user_pair(mapping.workspace, ("cam:32", "cam:36"), _INTRINSICS, _NUMBERS)
    assert pair is not None
    assert pair.names == ("cam/0000002", "cam/0000006")
    models, ladder = reconstruct(
        mapping.workspace, mapping.mapper_options(), mapping.stage, KEYFRAMES, [pair]
    )
    assert ladder[-1]["pair"] == ["cam/0000002", "cam/0000006"]
    assert models[0].num_reg_images() == KEYFRAMES
    assert _rms(models[0], poses) < 0.01
    assert find_user_pair(mapping.workspace, ("cam:30", "cam:45"), _INTRINSICS, _NUMBERS) is None
    with pytest.raises(JobError, match="same nearest keyframe"):
        find_user_pair(mapping.workspace, ("cam:33", "cam:33"), _INTRINSICS, _NUMBERS)
    with pytest.raises(JobError, match="camera 'hat'"):
        find_user_pair(mapping.workspace, ("hat:33", "cam:33"), _INTRINSICS, _NUMBERS)


def _uncalibrated_context(workspace: Path) -> MappingContext:
    """Return a context for the keyframes of `write_wall` with an uncalibrated camera."""
    write_wall(workspace)
    _link_one_way(workspace)
    return MappingContext(
        workspace=workspace,
        intrinsics=_INTRINSICS,
        mapper_options=lambda: make_mapper_options(MapOptions(), [], 1.0),
        calibrated_ids=[],
        stage=StageContext(work_dir=workspace, threads=1),
        frame_numbers=_NUMBERS,
    )


def _radial() -> Camera:
    return Camera(model="RADIAL", width_px=640, height_px=480, params=np.array([421.0, 320, 240, 0, 0]))


def test_the_users_initial_pair_is_used_again_if_the_camera_model_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapping = _uncalibrated_context(tmp_path)
    changed = _radial().to_pycolmap()
    changed.camera_id = 1
    monkeypatch.setattr(intrinsics_check, "select_camera_models", lambda *_: ({1: changed}, frozenset()))
    options = MapOptions(init_frames=("cam:31", "cam:35"))
    models, log = reconstruct_with_intrinsics(mapping, options, {1: "cam"}, KEYFRAMES)
    assert log["better_lenses"] == {"cam": "RADIAL"}
    assert models[0].camera(1).model_name == "RADIAL"
    assert log["initial_pair_ladder"][0]["pair"] == ["cam/0000001", "cam/0000005"]
    assert log["named_initial_pair"]["pair"] == ["cam/0000001", "cam/0000005"]


@pytest.mark.parametrize("crop", [1.0, 0.9])
def test_only_a_principal_point_that_moved_is_refined_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, crop: float
) -> None:
    """A calibrated principal point is hardly ever exactly in the middle of the picture."""
    mapping = _uncalibrated_context(tmp_path)
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        camera = database.read_camera(1)
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, [420.0, 321.5, 238.5, 0.0]
        database.update_camera(camera)
    freed_centre = []

    def cost(part: Any, settings: Any, *, centre: bool = False, **_: Any) -> float:
        """Return a cost: a second radial term halves it, a free centre reduces it to 99 % or to `crop`."""
        freed_centre.append(centre)
        left = 50.0 if part.camera(1).model_name == "RADIAL" else 100.0
        return left * min(0.99, crop) if centre else left

    monkeypatch.setattr(intrinsics_check, "_adjustment_cost", cost)
    _, log = reconstruct_with_intrinsics(
        mapping, MapOptions(init_frames=("cam:31", "cam:35")), {1: "cam"}, KEYFRAMES
    )
    assert log["better_lenses"] == {"cam": "RADIAL"}
    first_map = [False, False, False, True, False]
    assert freed_centre == first_map + ([False, True] if crop < 0.95 else [])


def test_the_log_holds_the_camera_models_of_both_updates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapping = _uncalibrated_context(tmp_path)
    updates = iter([({"cam": _radial(), "hat": _radial()}, {1}), ({"cam": _radial()}, {1})])

    def change(*_: Any, **__: Any) -> tuple[dict[str, CameraIntrinsics], set[int]]:
        found, decentred = next(updates)
        return {name: CameraIntrinsics(camera, calibrated=False) for name, camera in found.items()}, decentred

    monkeypatch.setattr(initial_models, "update_camera_models", change)
    _, log = reconstruct_with_intrinsics(
        mapping, MapOptions(init_frames=("cam:31", "cam:35")), {1: "cam", 2: "hat"}, KEYFRAMES
    )
    assert log["better_lenses"] == {"cam": "RADIAL", "hat": "RADIAL"}
