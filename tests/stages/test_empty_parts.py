"""Empty parts of a result: they are left out and said, and the rest is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import LEFT_OUT, ExportInputs, export_results
from bodycap_batch.export.metrics import collect_metrics
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.preview import render_preview
from bodycap_batch.report import ReportInputs
from tests.bodies import merged, reaching
from tests.reports import written
from tests.stages.conftest import Estimated, context
from tests.stages.test_export import inputs_of
from tests.stages.test_preview import decode, preview_inputs

CAMERAS = {"cameras.glb", "cameras.usd", "cameras.json"}
FORMATS = ("ply", "bvh", "glb", "tum", "csv", "colmap", "blender", "usd", "c3d", "trc", "npz")
MOTION = {"motion.bvh", "motion.glb", "motion.usd", "joints.c3d", "joints.trc", "joints.npz", "joints.csv"}


def without_points(scene: Map) -> Map:
    return replace(
        scene,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        point_error_px=np.zeros(0),
        obs_keyframe=np.zeros(0, np.int64),
        obs_point=np.zeros(0, np.int64),
        obs_feature=np.zeros(0, np.int64),
        obs_px=np.zeros((0, 2)),
    )


def without_poses(path: Trajectory) -> Trajectory:
    count = len(path.status)
    return replace(
        path,
        gauge_from_cam=np.full((count, 4, 4), np.nan),
        covariance=np.full((count, 6, 6), np.nan),
        status=(FrameStatus.FEW_TRACKS,) * count,
        inliers=np.zeros(count, np.int64),
        error_px=np.full(count, np.nan),
    )


def empty_second_map(inputs: ExportInputs) -> ExportInputs:
    return replace(inputs, maps=(inputs.maps[0], without_points(inputs.maps[1])))


def empty_maps(inputs: ExportInputs) -> ExportInputs:
    return replace(inputs, maps=tuple(map(without_points, inputs.maps)))


def lost_camera(inputs: ExportInputs) -> ExportInputs:
    assert inputs.merge is not None
    first, *others = inputs.trajectories
    lost, *used = inputs.merge.trajectories
    merge = replace(inputs.merge, trajectories=(without_poses(lost), *used))
    return replace(inputs, trajectories=(without_poses(first), *others), merge=merge)


def nothing_at_all(inputs: ExportInputs) -> ExportInputs:
    paths = tuple(map(without_poses, inputs.trajectories))
    return replace(empty_maps(inputs), trajectories=paths, merge=None)


def no_measured_joint(inputs: ExportInputs) -> ExportInputs:
    assert inputs.merge is not None
    return replace(inputs, merge=replace(inputs.merge, solved=np.zeros_like(inputs.merge.solved)))


def no_frames(inputs: ExportInputs) -> ExportInputs:
    return replace(inputs, merge=merged(reaching(0), projected=False)[0])


@pytest.mark.parametrize(
    ("change", "missing", "said"),
    [
        (empty_second_map, {"map_1.ply"}, ["map_1.ply is not written: its map has no points"]),
        (empty_maps, {"map_1.ply"}, ["map.ply shows camera paths only", "map_1.ply is not written"]),
        (lost_camera, set(), ["trajectories/torso.tum has no poses"]),
        (
            nothing_at_all,
            {"map.ply", "map_1.ply", *MOTION, *CAMERAS},
            ["map.ply is not written", "left_palm.tum has no"],
        ),
        (no_measured_joint, {"joints.trc"}, ["joints.trc is not written: no exported joint was measured"]),
        (
            no_frames,
            {*MOTION, *CAMERAS},
            ["the files of the motion are not written: the motion has no frames"],
        ),
    ],
)
def test_an_empty_part_is_left_out_and_said_and_the_rest_is_written(
    tmp_path: Path, change: Callable[[ExportInputs], ExportInputs], missing: set[str], said: list[str]
) -> None:
    whole, inputs = inputs_of(tmp_path / "whole"), change(inputs_of(tmp_path / "empty"))
    options = ExportOptions(formats=FORMATS)
    names = [
        {str(path) for path in export_results(each, options, StageContext(work_dir=tmp_path))}
        for each in (whole, inputs)
    ]
    left = {name for name in names[0] - names[1] if not name.startswith(("blender", "bodycap"))}
    assert left == missing
    assert all((inputs.out_dir / name).stat().st_size > 0 for name in names[1])
    sentences = json.loads((inputs.out_dir / "metrics.json").read_text())[LEFT_OUT]
    assert [text for text in said if not any(text in sentence for sentence in sentences)] == []
    assert json.loads((whole.out_dir / "metrics.json").read_text())[LEFT_OUT] == []


@pytest.mark.parametrize("change", [empty_second_map, empty_maps, lost_camera, nothing_at_all])
def test_the_page_says_what_is_left_out(
    inputs: ReportInputs, tmp_path: Path, change: Callable[[ExportInputs], ExportInputs]
) -> None:
    second = replace(inputs.maps[0], gauge="map-1")
    export = change(
        ExportInputs(
            out_dir=tmp_path,
            maps=(*inputs.maps, second),
            trajectories=tuple(each.trajectory for each in inputs.registrations),
            clocks=inputs.clocks,
            selections=inputs.selections,
            merge=inputs.merge,
            log={"reach": {"judged": True, "distances": 90, "within_reach": 1.0}},
        )
    )
    motion = None if export.merge is None else export.merge.motion
    text = written(
        replace(
            inputs,
            maps=export.maps,
            registrations=tuple(
                replace(each, trajectory=path)
                for each, path in zip(inputs.registrations, export.trajectories, strict=True)
            ),
            merge=export.merge,
            metrics={
                **collect_metrics(export, motion, {}),
                LEFT_OUT: ["map_1.ply is not written: no points"],
            },
            files=("map.ply",),
        ),
        tmp_path,
    )
    assert "map_1.ply is not written: no points." in text


def test_the_video_of_a_map_without_points_shows_the_cameras(estimated: Estimated, tmp_path: Path) -> None:
    scene = without_points(estimated.result.maps[0])
    empty = replace(estimated, result=replace(estimated.result, maps=(scene,)))
    path = render_preview(preview_inputs(empty, tmp_path / "preview.mp4"), context(tmp_path))
    assert len(decode(path)) > 0
