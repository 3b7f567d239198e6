"""A large map: built from skeletal keyframes, the other keyframes are resected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping import build, build_map, extend_map
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.mapping.reconstruction.two_step_adjustment import adjust_in_two_steps
from bodycap_batch.model.geometry import align_points
from bodycap_batch.model.scene import KeyframeSelection, MapResult
from tests.rooms import stroll
from tests.stages.conftest import DARK, FRAMES, context

pytestmark = pytest.mark.slow

_EVERY = [frame for frame in range(0, FRAMES, 2) if frame not in DARK]


@pytest.fixture(scope="module")
def result(stroll_capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> MapResult:
    """The stroll's map, built as a large one: with a limit of 40 keyframes."""
    return _built(stroll_capture, MapOptions(), context(tmp_path_factory.mktemp("long")))


def _built(
    capture: Capture, options: MapOptions, surroundings: StageContext, frames: Sequence[int] = _EVERY
) -> MapResult:
    selections = [_selection(camera.name, frames) for camera in capture.cameras]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bodycap_batch.mapping.matching.pair_selection._EXHAUSTIVE_UP_TO", 10)
        return build_map(capture, selections, options, surroundings, skeletal_above=40)


def _selection(name: str, frames: Sequence[int]) -> KeyframeSelection:
    return KeyframeSelection(
        camera=name,
        frames=np.array(frames),
        frame_count=FRAMES,
        sharpness=np.ones(FRAMES),
        noise_px=0.3,
    )


def test_some_keyframes_are_skeletal_and_all_others_are_resected(result: MapResult) -> None:
    log = result.log["placed"]
    count = 2 * len(_EVERY)
    assert log["carrying"] + log["placed"] == len(result.maps[0].keyframe_camera) == count
    assert log["carrying"] < 0.8 * count


def test_one_thread_gives_the_same_map(result: MapResult, stroll_capture: Capture, tmp_path: Path) -> None:
    again = _built(stroll_capture, MapOptions(), StageContext(work_dir=tmp_path, threads=1))
    assert again.maps[0].gauge == result.maps[0].gauge
    assert (again.maps[0].points == result.maps[0].points).all()


def test_exhaustive_matching_matches_every_pair(stroll_capture: Capture, tmp_path: Path) -> None:
    every = _built(stroll_capture, MapOptions(pairs="exhaustive"), context(tmp_path))
    count = 2 * len(_EVERY)
    assert every.log["pairs"] == count * (count - 1) // 2
    assert "placed" not in every.log


def test_dark_keyframes_are_left_out(stroll_capture: Capture, tmp_path: Path) -> None:
    with_dark = list(range(0, FRAMES, 2))
    found = _built(stroll_capture, MapOptions(), context(tmp_path), with_dark)
    inside = zip(found.maps[0].keyframe_camera, found.maps[0].keyframe_frame.tolist(), strict=True)
    dark = {("left_palm", frame) for frame in DARK if frame in with_dark}
    wanted = {(camera.name, frame) for camera in stroll_capture.cameras for frame in with_dark}
    assert set(inside) == wanted - dark


def test_a_skeletal_keyframe_that_was_removed_is_resected(
    stroll_capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repair, removed = build.repair_model, list[str]()

    def cutting(*arguments: Any) -> tuple[Any, dict[str, object]]:
        model, log = repair(*arguments)
        number = sorted(model.reg_image_ids())[-1]
        removed.append(model.image(number).name)
        return sub_model(model, set(model.reg_image_ids()) - {number}), log

    monkeypatch.setattr(build, "repair_model", cutting)
    found = _built(stroll_capture, MapOptions(), context(tmp_path))
    log = found.log["placed"]
    assert log["carrying"] + log["placed"] == len(found.maps[0].keyframe_camera)
    camera, frame = removed[0].split("/")
    inside = zip(found.maps[0].keyframe_camera, found.maps[0].keyframe_frame.tolist(), strict=True)
    assert (camera, int(frame)) in set(inside)


def _position_errors(result: MapResult) -> np.ndarray:
    """Return the position error of each keyframe after alignment, metres."""
    found = result.maps[0]
    mine = found.map_from_cam[:, :3, 3]
    poses = stroll(FRAMES)
    pairs = zip(found.keyframe_camera, found.keyframe_frame.tolist(), strict=True)
    true = np.array([poses[camera][frame][:3, 3] for camera, frame in pairs])
    return np.asarray(np.linalg.norm(align_points(mine, true).apply(mine) - true, axis=1))


def test_resected_keyframes_are_as_accurate_as_skeletal_ones(result: MapResult) -> None:
    errors = _position_errors(result)
    # A quarter of a pixel at 3 m and 240 px makes 3 mm for each point; a pose has dozens.
    assert np.sqrt((errors**2).mean()) < 0.01
    assert errors.max() < 0.03


def test_a_large_map_is_adjusted_in_two_steps(result: MapResult, monkeypatch: pytest.MonkeyPatch) -> None:
    model = pycolmap.Reconstruction(str(result.workspace / "sparse" / "0"))
    rng = np.random.default_rng(5)
    spread = np.ptp(
        [model.image(number).projection_center() for number in model.reg_image_ids()], axis=0
    ).max()
    for number in model.point3D_ids():
        model.point3D(number).xyz += rng.normal(0.0, 0.02 * spread, 3)
    for number in model.reg_image_ids():
        pose = model.image(number).cam_from_world()
        moved = pycolmap.Rigid3d(pose.rotation, pose.translation + rng.normal(0.0, 0.01 * spread, 3))
        model.frame(model.image(number).frame_id).set_cam_from_world(model.image(number).camera_id, moved)
    before = _centres_position_errors(model)
    adjusted: list[int] = []
    create = pycolmap.create_default_bundle_adjuster

    def noted(options: object, config: pycolmap.BundleAdjustmentConfig, part: object) -> object:
        adjusted.append(len(config.images))
        return create(options, config, part)

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", noted)
    adjust_in_two_steps(
        model, make_mapper_options(MapOptions(), sorted(model.cameras), 1.0), sorted(model.cameras)
    )
    assert adjusted[0] + adjusted[2] == model.num_reg_images()
    assert before > 0.02
    assert _centres_position_errors(model) < 0.005


def _centres_position_errors(model: pycolmap.Reconstruction) -> float:
    """Return the position error of a model's keyframes after alignment, root mean square."""
    poses = stroll(FRAMES)
    found, true = [], []
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        camera, frame = image.name.split("/")
        found.append(image.projection_center())
        true.append(poses[camera][int(frame)][:3, 3])
    mine, right = np.array(found), np.array(true)
    return float(np.sqrt(((align_points(mine, right).apply(mine) - right) ** 2).sum(axis=1).mean()))


def test_a_large_map_is_extended_without_global_adjustments(
    result: MapResult, stroll_capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adjusted: list[int] = []
    create = pycolmap.create_default_bundle_adjuster

    def noted(
        options: object, config: pycolmap.BundleAdjustmentConfig, model: pycolmap.Reconstruction
    ) -> object:
        adjusted.append(len(config.images))
        return create(options, config, model)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("the whole map was adjusted while keyframes were added")

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", noted)
    monkeypatch.setattr(pycolmap.IncrementalMapper, "iterative_global_refinement", never)
    extra = {"torso": np.array([21, 31]), "left_palm": np.array([11])}
    grown = extend_map(stroll_capture, result, extra, MapOptions(), context(tmp_path), skeletal_above=40)
    assert len(grown.maps[0].keyframe_camera) == len(result.maps[0].keyframe_camera) + 3
    assert adjusted == [3]
    assert _position_errors(grown).max() < 0.03


@pytest.mark.parametrize("entry", ["cut", "doubtful"])
def test_a_growth_registers_removed_keyframes_again(
    stroll_capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry: str
) -> None:
    """A keyframe is removed at the end of the repair, or is not found when it is registered again."""
    repair = build.repair_model

    def cutting(*arguments: Any) -> tuple[Any, dict[str, object]]:
        model, log = repair(*arguments)
        number = sorted(model.reg_image_ids())[-1]
        kept = sub_model(model, set(model.reg_image_ids()) - {number})
        return kept, {**log, entry: [model.image(number).name]}

    monkeypatch.setattr(build, "repair_model", cutting)
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    frames = list(range(0, FRAMES, 4))
    found = _built(stroll_capture, MapOptions(), context(first), frames)
    ((camera, removed),) = found.diagnostics.misplaced.items()
    extra = {camera: np.array([next(frame + 1 for frame in frames if frame not in DARK)])}
    grown = extend_map(stroll_capture, found, extra, MapOptions(), context(second), skeletal_above=40)
    inside = zip(grown.maps[0].keyframe_camera, grown.maps[0].keyframe_frame.tolist(), strict=True)
    assert (camera, *removed) in set(inside)
    assert not grown.diagnostics.misplaced
    assert _position_errors(grown).max() < 0.03
