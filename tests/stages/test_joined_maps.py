"""Three maps without a common view, aligned through the body, up to the exported files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.config.options import ExportOptions, MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.formats.ply import read_ply
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.synthetic import SynthOptions
from tests.bench.joining import SPLITS
from tests.bench.posed import posed
from tests.scenes import small_map

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture():
    split = SPLITS["an arm each"]
    return posed(SynthOptions(seconds=16.0, cameras=tuple(split), seed=6, poses_only=True), split)


@pytest.fixture(scope="module")
def result(capture, tmp_path_factory):
    context = StageContext(work_dir=tmp_path_factory.mktemp("merge"))
    return merge_trajectories(capture.inputs, MergeOptions(), context)


def test_all_cameras_are_used_in_one_world(capture, result):
    assert not result.unused_cameras
    assert set(result.world_from_map) == {"a", "b", "c"}
    assert {each.gauge for each in result.trajectories} == {"world"}
    assert len(result.trajectories) == 5
    for role in ("LeftHand", "RightHand", "LeftArm", "RightArm"):
        assert result.solved[result.skeleton.roles.index(role)]
    stated = result.report.joined_cameras
    assert set(stated) == {"left_palm", "left_upper_arm", "right_palm", "right_upper_arm"}


def test_alignment_errors_are_within_the_stated_sigmas(capture, result):
    main = result.world_from_map["a"]
    for each in capture.inputs.trajectories:
        if each.gauge == "a":
            continue
        centres = each.gauge_from_cam[each.localised, :3, 3]
        true = main.after(capture.gauges["a"]).after(capture.gauges[each.gauge].inverse()).apply(centres)
        off = np.linalg.norm(result.world_from_map[each.gauge].apply(centres) - true, axis=1)
        sigma = result.report.joined_cameras[each.camera].sigma_m
        # Three sigmas of each of three axes; a sigma of 6 cm would have been rejected.
        assert np.median(off) < 3.0 * np.sqrt(3.0) * sigma
        assert sigma < 0.06


def test_trajectories_follow_their_maps(capture, result):
    before = {each.camera: each for each in capture.inputs.trajectories}
    for after in result.trajectories:
        place = result.world_from_map[before[after.camera].gauge]
        kept = after.localised
        moved = place.apply_to_poses(before[after.camera].gauge_from_cam)
        assert_allclose(after.gauge_from_cam[kept, :3, :3], moved[kept, :3, :3], atol=1e-9)
        # The solution moves noisy centres (sigma 5 mm), but not whole paths.
        shift = (after.gauge_from_cam - moved)[kept, :3, 3]
        assert np.abs(np.median(shift, axis=0)).max() < 0.005


def test_every_map_is_written_into_the_world(capture, result, tmp_path):
    write_dataclass(result, tmp_path, "merge")
    kept = read_dataclass(MergeResult, tmp_path, "merge")
    assert_allclose(kept.joint_covariance_m2, result.joint_covariance_m2)
    maps = tuple(small_map(gauge, seed=index) for index, gauge in enumerate("abc"))
    inputs = ExportInputs(
        out_dir=tmp_path / "out",
        maps=maps,
        trajectories=capture.inputs.trajectories,
        clocks=capture.inputs.clocks,
        selections=(),
        merge=kept,
    )
    files = export_results(inputs, ExportOptions(), StageContext(work_dir=tmp_path))
    assert "map.ply" in {str(file) for file in files}
    assert not [file for file in files if file.name.startswith("map_") or "unplaced" in file.parts]
    points = read_ply(tmp_path / "out" / "map.ply").points
    for scene in maps:
        moved = result.world_from_map[scene.gauge].apply(scene.points)
        nearest = np.linalg.norm(points[None, :, :] - moved[:5, None, :], axis=-1).min(axis=1)
        assert nearest.max() < 1e-3
    for camera in ("left_palm", "right_upper_arm"):
        written = read_tum(tmp_path / "out" / "trajectories" / f"{camera}.tum")
        merged = next(each for each in result.trajectories if each.camera == camera)
        assert_allclose(written.world_from_cam, merged.gauge_from_cam[merged.localised], atol=1e-5)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert {model["frame"] for model in metrics["models"]} == {"world"}
    assert metrics["merge"]["joined_cameras"] == result.report.to_dict()["joined_cameras"]


def test_sigmas_of_joined_arms_are_larger_than_of_the_same_arms_in_one_map(capture, result, tmp_path):
    together = posed(capture.options)
    alone = merge_trajectories(together.inputs, MergeOptions(), StageContext(work_dir=tmp_path))
    hand = result.skeleton.roles.index("LeftHand")
    assert np.nanmedian(result.joint_sigma_m()[:, hand]) > np.nanmedian(alone.joint_sigma_m()[:, hand])
