"""The export stage: all files, their content, and errors of the disk."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled, JobError, StoreError
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.motion_files import motion_difference, without_unsolved_branches
from bodycap_batch.formats.bvh import read_bvh, write_bvh
from bodycap_batch.formats.c3d import read_c3d
from bodycap_batch.formats.ply import read_ply
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.formats.usd import read_usd
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection
from tests.bodies import CAMERAS, merged, reaching
from tests.scenes import small_map

WORLD_FROM_MAP = Similarity(0.5, so3_exp([0.2, -0.4, 1.0]), np.array([1.0, 2.0, 0.5]))


def inputs_of(folder: Path, *, with_body: bool = True) -> ExportInputs:
    result, clocks = merged(reaching(), offset_s=0.25, world_from_map={"map-0": WORLD_FROM_MAP})
    back = WORLD_FROM_MAP.inverse()
    in_map = tuple(
        replace(path, gauge="map-0", gauge_from_cam=back.apply_to_poses(path.gauge_from_cam))
        for path in result.trajectories
    )
    selections = tuple(
        KeyframeSelection(
            camera=camera, frames=np.array([0, 4, 8]), frame_count=60, sharpness=np.ones(60), noise_px=0.2
        )
        for camera in CAMERAS
    )
    return ExportInputs(
        out_dir=folder / "out",
        maps=(small_map(noise_px=0.5), small_map("map-1", seed=3, points=20)),
        trajectories=in_map,
        clocks=clocks,
        selections=selections,
        merge=result if with_body else None,
        log={"initial_pairs": [["torso/1", "torso/5"]]},
    )


def run(inputs: ExportInputs, **options: Any) -> dict[str, Any]:
    context = StageContext(work_dir=inputs.out_dir.parent)
    files = export_results(inputs, ExportOptions(**options), context)
    assert all((inputs.out_dir / file).is_file() for file in files)
    assert not list(inputs.out_dir.rglob(".*"))
    return dict(json.loads((inputs.out_dir / "metrics.json").read_text()))


@dataclass(frozen=True)
class Exported:
    """What an export with default options was given, and what it wrote."""

    inputs: ExportInputs
    files: tuple[Path, ...]
    metrics: dict[str, Any]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """An export with default options. No test changes its files."""
    inputs = inputs_of(tmp_path_factory.mktemp("exported"))
    files = export_results(inputs, ExportOptions(), StageContext(work_dir=inputs.out_dir.parent))
    assert not list(inputs.out_dir.rglob(".*"))
    return Exported(inputs, tuple(files), json.loads((inputs.out_dir / "metrics.json").read_text()))


def test_all_files_are_there(exported: Exported) -> None:
    inputs, files = exported.inputs, exported.files
    expected = {
        "map.ply",
        "map_1.ply",
        "motion.bvh",
        "motion.glb",
        "cameras.glb",
        "cameras.json",
        "joints.csv",
        "frames.csv",
        "metrics.json",
        "blender_scene.json",
        "blender_scene.py",
        "bodycap_blender.zip",
    }
    expected |= {f"trajectories/{camera}.tum" for camera in CAMERAS}
    expected |= {f"colmap/{n}/{name}.bin" for n in (0, 1) for name in ("cameras", "images", "points3D")}
    assert {str(file) for file in files} == expected
    assert {str(p.relative_to(inputs.out_dir)) for p in inputs.out_dir.rglob("*") if p.is_file()} == expected


def test_two_exports_are_the_same_bytes(exported: Exported, tmp_path: Path) -> None:
    again = inputs_of(tmp_path)
    run(again)
    for name in exported.files:
        assert (again.out_dir / name).read_bytes() == (exported.inputs.out_dir / name).read_bytes(), name


def test_map_and_paths_share_the_world(exported: Exported) -> None:
    inputs = exported.inputs
    cloud = read_ply(inputs.out_dir / "map.ply")
    points = len(inputs.maps[0].points)
    np.testing.assert_allclose(cloud.points[:points], WORLD_FROM_MAP.apply(inputs.maps[0].points))
    np.testing.assert_array_equal(cloud.colors[:points], inputs.maps[0].colors)
    torso = read_tum(inputs.out_dir / "trajectories" / "torso.tum").world_from_cam[:, :3, 3]
    nearest = np.linalg.norm(cloud.points[points:, None] - torso[None], axis=-1).min(axis=0)
    assert nearest.max() < 1e-8
    assert len(np.unique(cloud.colors[points:], axis=0)) == len(CAMERAS)


def test_trajectories_hold_localised_frames_on_the_cameras_own_clock(exported: Exported) -> None:
    inputs = exported.inputs
    assert inputs.merge is not None
    for path in inputs.merge.trajectories:
        file = inputs.out_dir / "trajectories" / f"{path.camera}.tum"
        back = read_tum(file)
        np.testing.assert_array_equal(back.times_ns, path.times_ns[path.localised])
        np.testing.assert_allclose(back.world_from_cam, path.gauge_from_cam[path.localised], atol=2e-9)
        assert "world_from_camera" in file.read_text().splitlines()[1]


def test_frames_table_has_every_frame_and_both_clocks(exported: Exported) -> None:
    inputs = exported.inputs
    with open(inputs.out_dir / "frames.csv", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 60 * len(CAMERAS)
    assert rows[0]["camera"] == "torso"
    assert (rows[0]["time"], rows[0]["common_time"]) == ("4.750000000", "5.000000000")
    lost = [row for row in rows if row["status"] == "LOST"]
    assert len(lost) == 5 * len(CAMERAS)
    assert {(row["reason"], row["inliers"], row["error"]) for row in lost} == {("BLUR", "3", "")}
    assert (rows[0]["status"], rows[0]["reason"], rows[0]["error"]) == ("REGISTERED", "", "0.500")


def test_metrics_hold_the_tables(exported: Exported) -> None:
    inputs, metrics = exported.inputs, exported.metrics
    torso, total, scene = metrics["cameras"]["torso"], metrics["total"], inputs.maps[0]
    assert (torso["frames"], torso["frames_registered"]) == (60, 55)
    assert torso["coverage"] == pytest.approx(55 / 60)
    assert torso["status"] == {"BLUR": 5, "REGISTERED": 55}
    assert (torso["keyframes_selected"], torso["keyframes"]) == (3, 6)
    mine = np.isin(scene.obs_keyframe, scene.keyframes_of("torso"))
    other = inputs.maps[1]
    theirs = np.isin(other.obs_keyframe, other.keyframes_of("torso"))
    assert torso["measurements"] == mine.sum() + theirs.sum()
    assert torso["points"] == len(np.unique(scene.obs_point[mine])) + len(np.unique(other.obs_point[theirs]))
    assert total["cameras"] == total["cameras_registered"] == 3
    assert (total["frames"], total["frames_registered"]) == (180, 165)
    assert (total["points"], total["keyframes"]) == (80, 10)
    assert total["measurements"] == len(scene.obs_px) + len(other.obs_px)
    first, second = metrics["models"]
    assert (first["frame"], second["frame"]) == ("world", "map-1")
    assert first["keyframes"] == {"left_palm": 2, "torso": 3}
    # a two-dimensional error of 0.5 px per coordinate has a mean of 0.5 · √(π/2) = 0.63
    assert first["mean_reprojection_error_px"] == pytest.approx(0.627, rel=0.12)
    assert second["mean_reprojection_error_px"] < 1e-9
    assert torso["registration"]["mean_reprojection_error_px"] == pytest.approx(0.5)
    assert metrics["frame"] == "world"
    assert metrics["merge"]["scale"]["source"] == "height"
    assert metrics["merge"]["scale"]["relative_sigma"] is None
    assert metrics["mapping"] == {"initial_pairs": [["torso/1", "torso/5"]]}


def test_metrics_say_which_joints_were_observed(exported: Exported) -> None:
    joints = exported.metrics["motion"]["joints"]
    assert joints["LeftHand"] == {"role": "LeftHand", "observed": True, "observed_share": 1.0}
    assert joints["LeftUpLeg"] == {"role": "LeftUpLeg", "observed": False, "observed_share": 0.0}


def test_motion_file_is_the_projected_motion(exported: Exported) -> None:
    inputs, metrics = exported.inputs, exported.metrics
    assert inputs.merge is not None
    motion = inputs.merge.motion
    model, back = read_bvh(inputs.out_dir / "motion.bvh")
    assert back is not None
    assert model.joints == motion.skeleton.joints
    position_m, angle_deg = motion_difference(back, motion)
    # six decimals of a centimetre and of a degree, along a chain of seven joints with a total length of 2 m
    assert position_m < 1e-6
    assert angle_deg < 1e-4
    assert metrics["motion"]["fps"] == 30.0
    assert metrics["motion"]["gap"]["cameras"]["torso"]["p95_m"] < 0.02


def test_the_body_stands_upright_in_the_file(exported: Exported) -> None:
    """In the file, Y is up, the left hand starts on +X of the right one, the feet are on the floor; cm."""
    inputs = exported.inputs
    text = (inputs.out_dir / "motion.bvh").read_text()
    first = list(map(float, text.splitlines()[text.splitlines().index("MOTION") + 3].split()))
    assert 90 < first[1] < 97
    _, motion = read_bvh(inputs.out_dir / "motion.bvh")
    assert motion is not None
    world = motion.world_from_joint()[..., :3, 3]
    at = {role: world[0, index] for index, role in enumerate(motion.skeleton.roles)}
    assert at["LeftHand"][0] > at["RightHand"][0] + 0.2
    assert at["Head"][2] > 1.5
    assert abs(at["LeftFoot"][2]) < 0.12
    assert at["LeftToeBase"][1] < at["LeftFoot"][1]


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"euler_order": "XYZ"}, "\t\tCHANNELS 3 Xrotation Yrotation Zrotation"),
        ({"units": "m"}, "\t\tCHANNELS 3 Zrotation Xrotation Yrotation"),
    ],
)
def test_layout_options(tmp_path: Path, options: dict[str, Any], line: str) -> None:
    inputs = inputs_of(tmp_path)
    run(inputs, formats=("bvh",), **options)
    assert line in (inputs.out_dir / "motion.bvh").read_text().splitlines()
    _, motion = read_bvh(inputs.out_dir / "motion.bvh")
    assert motion is not None
    assert 0.85 < motion.root_in_world_m[0, 2] < 1.0


def test_only_the_formats_asked_for(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path)
    run(inputs, formats=("tum",))
    names = sorted(path.name for path in inputs.out_dir.iterdir())
    assert names == ["metrics.json", "trajectories"]


def test_further_formats_hold_the_same_joints(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path)
    run(inputs, formats=("usd", "c3d", "trc", "npz", "csv"), names="mixamo", root="in_place")
    names = {path.name for path in inputs.out_dir.iterdir()}
    assert names == {
        *("motion.usd", "joints.c3d", "joints.trc", "joints.npz", "joints.csv", "frames.csv", "metrics.json"),
        *("cameras.usd", "cameras.json"),
    }
    assert inputs.merge is not None
    motion = inputs.merge.motion
    arrays = np.load(inputs.out_dir / "joints.npz", allow_pickle=False)
    # files for measurements stay in the world, whatever the layout of the files for animation
    np.testing.assert_array_equal(arrays["world"], motion.world_from_joint()[..., :3, 3])
    np.testing.assert_array_equal(arrays["observed"], motion.observed)
    measured = inputs.merge.solved
    in_c3d = read_c3d(inputs.out_dir / "joints.c3d").x_in_world_m
    np.testing.assert_allclose(in_c3d[:, measured], arrays["world"][:, measured], atol=1e-6)
    back = read_usd(inputs.out_dir / "motion.usd")
    assert back.skeleton.joints[0] == "mixamorig:Hips"
    assert np.abs(back.root_in_world_m[:, :2]).max() < 1e-6


@pytest.mark.parametrize("hierarchy", ["full", "solved"])
def test_the_tables_have_the_sigmas_of_the_joints(tmp_path: Path, hierarchy: str) -> None:
    inputs = inputs_of(tmp_path)
    assert inputs.merge is not None
    hand = inputs.merge.skeleton.index_of_role("LeftHand")
    covariance = np.full((60, len(inputs.merge.solved), 3, 3), np.nan)
    covariance[:, hand] = np.diag([1e-4, 4e-4, 7e-4])
    merge = replace(inputs.merge, joint_covariance_m2=covariance)
    run(replace(inputs, merge=merge), formats=("csv", "npz"), hierarchy=hierarchy)
    arrays = np.load(inputs.out_dir / "joints.npz", allow_pickle=False)
    has_sigma = arrays["names"] == "LeftHand"
    np.testing.assert_allclose(arrays["sigma_m"][:, has_sigma], 0.02)
    assert np.isnan(arrays["sigma_m"][:, ~has_sigma]).all()
    with open(inputs.out_dir / "joints.csv", newline="") as handle:
        rows = {(row["joint"], row["sigma_m"]) for row in csv.DictReader(handle) if row["sigma_m"]}
    assert rows == {("LeftHand", "0.020000")}


def test_a_missing_library_is_reported_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = inputs_of(tmp_path)
    monkeypatch.setattr("bodycap_batch.formats.optional_libraries.find_spec", lambda name: None)
    with pytest.raises(JobError, match="C3D"):
        run(inputs, formats=("bvh", "c3d"))
    assert not inputs.out_dir.exists()


def test_solved_hierarchy_drops_unsolved_branches(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path)
    run(inputs, formats=("bvh",), hierarchy="solved")
    model, motion = read_bvh(inputs.out_dir / "motion.bvh")
    assert motion is not None
    assert "LeftHand" in model.joints
    assert not {"Head", "LeftUpLeg", "LeftFoot"} & set(model.joints)
    assert {"Hips", "Spine", "LeftShoulder"} <= set(model.joints)
    assert inputs.merge is not None
    whole = inputs.merge.motion
    part = without_unsolved_branches(whole, inputs.merge.solved)
    hand, same = whole.skeleton.index_of_role("LeftHand"), part.skeleton.index_of_role("LeftHand")
    np.testing.assert_allclose(
        part.world_from_joint()[:, same], whole.world_from_joint()[:, hand], atol=1e-12
    )


def test_a_joint_that_loses_its_children_ends_where_they_were() -> None:
    motion = reaching(3)
    solved = np.array([role == "Spine1" for role in motion.skeleton.roles])
    part = without_unsolved_branches(motion, solved).skeleton
    assert part.joints == ("Hips", "Spine", "Spine1")
    neck = motion.skeleton.index_of_role("Neck")
    np.testing.assert_array_equal(part.end_offsets_m[2], motion.skeleton.offsets_m[neck])


def test_without_a_body_everything_is_in_the_maps_gauge(tmp_path: Path) -> None:
    inputs = replace(inputs_of(tmp_path, with_body=False), partial_reason="the arms could not be placed")
    metrics = run(inputs)
    assert not (inputs.out_dir / "motion.bvh").exists()
    assert (metrics["frame"], metrics["metric"], metrics["partial"]) == ("map-0", False, True)
    assert metrics["partial_reason"] == "the arms could not be placed"
    heading = (inputs.out_dir / "trajectories" / "torso.tum").read_text().splitlines()[:3]
    assert "gauge map-0" in heading[1]
    cloud = read_ply(inputs.out_dir / "map.ply")
    np.testing.assert_array_equal(cloud.points[:60], inputs.maps[0].points)
    back = read_tum(inputs.out_dir / "trajectories" / "torso.tum")
    kept = inputs.trajectories[0].localised
    np.testing.assert_allclose(back.world_from_cam, inputs.trajectories[0].gauge_from_cam[kept], atol=2e-9)


def test_a_camera_that_could_not_be_placed_is_kept_apart(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path)
    assert inputs.merge is not None
    merge = replace(
        inputs.merge, trajectories=inputs.merge.trajectories[:2], unused_cameras={"right_palm": "alone"}
    )
    lonely = replace(inputs.trajectories[2], gauge="map-1")
    inputs = replace(inputs, merge=merge, trajectories=(*inputs.trajectories[:2], lonely))
    metrics = run(inputs)
    folder = inputs.out_dir / "trajectories"
    assert (folder / "unplaced" / "right_palm.tum").is_file()
    assert not (folder / "right_palm.tum").exists()
    assert metrics["cameras"]["right_palm"]["frame"] == "map-1"
    assert metrics["merge"]["unused_cameras"] == {"right_palm": "alone"}


def test_a_camera_without_any_pose(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path, with_body=False)
    path = inputs.trajectories[0]
    nothing = replace(
        path,
        gauge_from_cam=np.full_like(path.gauge_from_cam, np.nan),
        status=(FrameStatus.NO_MAP,) * len(path.status),
        inliers=np.zeros(len(path.status), dtype=np.int64),
        error_px=np.full(len(path.status), np.nan),
    )
    metrics = run(replace(inputs, trajectories=(nothing, *inputs.trajectories[1:])))
    assert metrics["cameras"]["torso"]["coverage"] == 0.0
    assert metrics["cameras"]["torso"]["registration"]["mean_reprojection_error_px"] is None
    assert metrics["total"]["cameras_registered"] == 2


def test_a_full_disk_leaves_no_half_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = inputs_of(tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("bodycap_batch.formats.atomic_files.os.fsync", full)
    with pytest.raises(StoreError, match="No space left") as caught:
        export_results(inputs, ExportOptions(), StageContext(work_dir=tmp_path))
    assert "free some space" in str(caught.value.hint)
    assert not [path for path in inputs.out_dir.rglob("*") if path.is_file()]


def test_a_motion_that_reads_back_differently_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A writer with an error of 0.02° is refused."""
    inputs = inputs_of(tmp_path)

    def wrong(path: Path, motion: Any, **options: Any) -> None:
        local = motion.local_rotation.copy()
        local[10, 3] = local[10, 3] @ so3_exp([np.deg2rad(0.02), 0.0, 0.0])
        write_bvh(path, replace(motion, local_rotation=local), **options)

    monkeypatch.setattr("bodycap_batch.export.result_files.write_bvh", wrong)
    with pytest.raises(StoreError, match="differs from the solved motion"):
        export_results(inputs, ExportOptions(formats=("bvh",)), StageContext(work_dir=tmp_path))
    assert not (inputs.out_dir / "motion.bvh").exists()


def test_cancelling_stops_between_files(tmp_path: Path) -> None:
    with pytest.raises(Cancelled):
        export_results(
            inputs_of(tmp_path), ExportOptions(), StageContext(work_dir=tmp_path, cancelled=lambda: True)
        )


@pytest.mark.data
@pytest.mark.parametrize("folder", ["room12", "room131"])
def test_a_users_skeleton_keeps_its_file(data_root: Path, tmp_path: Path, folder: str) -> None:
    path = data_root / folder / "skeleton.bvh"
    body, _ = read_bvh(path)
    result, clocks = merged(reaching(20, body))
    inputs = replace(inputs_of(tmp_path), merge=result, clocks=clocks, trajectories=result.trajectories)
    run(inputs, formats=("bvh",))
    ours = [row.split() for row in (inputs.out_dir / "motion.bvh").read_text().splitlines()]
    theirs = [row.split() for row in path.read_text().splitlines()]
    end = theirs.index(["MOTION"])
    assert [row for row in ours[:end] if row[0] != "OFFSET"] == [
        row for row in theirs[:end] if row[0] != "OFFSET"
    ]
    for mine, given in zip(ours[:end], theirs[:end], strict=True):
        if mine[0] == "OFFSET":
            assert list(map(float, mine[1:])) == list(map(float, given[1:]))
