"""The task that finds the wearer in the pictures: the cameras that it masks, and the key of the mask."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.model.camera_clock import CaptureClocks, FrameTiming
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.scene import MapResult
from bodycap_batch.model.wearer_view import WearerView
from bodycap_batch.report import ReportInputs
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import CLOCKS_NAME, wearer_name
from bodycap_batch.tasks.stage import read_summary
from bodycap_batch.tasks.wearer import WearerTask, run_wearer
from tests.reports import report_inputs


def _stored(folder: Path) -> ArtefactRef:
    folder.mkdir()
    return ArtefactRef(path=folder, digest=folder.name)


def _task(inputs: ReportInputs, folder: Path) -> WearerTask:
    scene, clocks, merge = (_stored(folder / name) for name in ("map", "clocks", "merge"))
    (scene.path / "workspace").mkdir()
    write_dataclass(
        MapResult(maps=inputs.maps, workspace=scene.path / "workspace", log={}), scene.path, "map"
    )
    write_dataclass(CaptureClocks(reference="torso", cameras=inputs.clocks), clocks.path, CLOCKS_NAME)
    write_dataclass(inputs.merge, merge.path, "merge")
    registrations = {}
    for found in inputs.registrations:
        name = found.trajectory.camera
        registrations[name] = _stored(folder / name)
        write_dataclass(found, registrations[name].path, "registration")
        write_dataclass(FrameTiming(nominal_fps=30.0), registrations[name].path, "timing")
    return WearerTask(map=scene, registrations=registrations, clocks=clocks, merge=merge)


def _looking_at_the_chest(inputs: ReportInputs, camera: str) -> ReportInputs:
    """Return the results with the poses of a camera 40 cm before the chest, looking at it."""
    assert inputs.merge is not None
    motion = inputs.merge.motion
    chest = motion.world_from_joint()[:, motion.skeleton.joints.index("Spine1")]
    back = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    poses = chest @ make_transform(back, [0.0, -0.40, 0.1])
    paths = tuple(
        replace(path, gauge_from_cam=np.where(path.localised[:, None, None], poses, np.nan))
        if path.camera == camera
        else path
        for path in inputs.merge.trajectories
    )
    return replace(inputs, merge=replace(inputs.merge, trajectories=paths))


def test_only_cameras_with_much_of_the_wearer_in_view_are_masked(tmp_path: Path) -> None:
    inputs = _looking_at_the_chest(report_inputs(), "left_palm")
    files = tmp_path / "wearer"
    files.mkdir()
    run_wearer(_task(inputs, tmp_path), StageContext(work_dir=tmp_path), files)
    summary = read_summary(files)
    assert summary["masked"] == ["left_palm"]
    assert summary["shares"]["left_palm"] > 0.4
    assert summary["shares"]["torso"] < 0.15
    assert [path.name for path in files.glob("wearer_*.json")] == ["wearer_left_palm.json"]
    view = read_dataclass(WearerView, files, wearer_name("left_palm"))
    assert view.lens.params.tolist() == inputs.maps[0].cameras["left_palm"].params.tolist()
    middle = np.array([[320.0, 240.0]])
    assert view.covers(middle, np.array([10])).all()


def test_a_camera_that_sees_the_room_where_the_body_should_be_is_not_masked(tmp_path: Path) -> None:
    inputs = _looking_at_the_chest(report_inputs(), "left_palm")
    (scene,) = inputs.maps
    own = np.flatnonzero(np.array(scene.keyframe_camera) == "left_palm")
    columns, rows = np.meshgrid(np.linspace(10, 630, 30), np.linspace(10, 470, 20))
    px = np.tile(np.column_stack([columns.ravel(), rows.ravel()]), (len(own), 1))
    keyframe = np.repeat(own, columns.size)
    evenly = replace(
        scene,
        obs_keyframe=keyframe,
        obs_point=np.zeros(len(px), dtype=np.int64),
        obs_feature=np.tile(np.arange(columns.size), len(own)),
        obs_px=px,
    )
    files = tmp_path / "wearer"
    files.mkdir()
    run_wearer(_task(replace(inputs, maps=(evenly,)), tmp_path), StageContext(work_dir=tmp_path), files)
    summary = read_summary(files)
    assert summary["masked"] == []
    assert 0.7 < summary["seen_through"]["left_palm"] < 1.4


def test_the_mask_is_part_of_the_key_of_tasks_that_read_pictures() -> None:
    capture = CaptureRef(config=CaptureConfig.model_construct(), digests={"torso": "a"})
    masked = replace(capture, wearer=ArtefactRef(path=Path("store"), digest="b"))
    moved = replace(capture, wearer=ArtefactRef(path=Path("elsewhere"), digest="b"))
    other = replace(capture, wearer=ArtefactRef(path=Path("store"), digest="c"))
    assert capture.key_content() == {"torso": "a"}
    assert masked.key_content() == moved.key_content() != capture.key_content()
    assert other.key_content() != masked.key_content()
