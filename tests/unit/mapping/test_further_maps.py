"""Maps of keyframes that joined no map: at the end, and when a map grows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping import extend_map, map_lost_keyframes, unmapped_keyframes
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.inputs import make_mapping_context
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.mapping.matching.skeletal_set import SKELETAL_ABOVE
from bodycap_batch.mapping.reconstruction.model_files import keyframe_names, write_models
from bodycap_batch.mapping.reconstruction.reconstruct import reconstruct
from bodycap_batch.mapping.results import make_result
from bodycap_batch.mapping.unmapped_keyframes import with_larger_model
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.model.scene import FrameStatus, MapResult, Trajectory
from tests.scenes import small_map
from tests.unit.mapping.wall import CAMERA, KEYFRAMES, LENS, write_wall

COUNT = len(CAMERA.times_ns)
NOTHING_POSED = Trajectory(
    camera="cam",
    gauge="map-0",
    frame_numbers=np.arange(COUNT),
    times_ns=CAMERA.times_ns,
    gauge_from_cam=np.full((COUNT, 4, 4), np.nan),
    covariance=np.full((COUNT, 6, 6), np.nan),
    status=(FrameStatus.FEW_TRACKS,) * COUNT,
    inliers=np.zeros(COUNT, dtype=np.int64),
    error_px=np.full(COUNT, np.nan),
)


def match_frames(workspace: Path, frames: Iterable[int], context: StageContext) -> None:
    refs = [ImageRef("cam", frame) for frame in frames]
    pairs = [(a, b) for a in refs for b in refs if a < b and b.frame - a.frame <= 5]
    match_pairs(workspace, pairs, {"cam": CameraIntrinsics(LENS, calibrated=True)}, context)


@pytest.mark.parametrize("contradicted", [0.0, 0.1])
def test_a_map_that_most_keyframes_do_not_join_gives_way_to_a_map_of_these(
    contradicted: float, tmp_path: Path
) -> None:
    """A map that contradicts itself does not: places that look the same are in it."""
    earlier, work = tmp_path / "earlier", tmp_path / "work"
    earlier.mkdir()
    work.mkdir()
    write_wall(earlier)
    context = StageContext(work_dir=work, threads=2)
    match_frames(earlier, range(3), context)
    match_frames(earlier, range(3, KEYFRAMES), context)
    capture = Capture(cameras=(CAMERA,))
    mapping = make_mapping_context(earlier, capture, MapOptions(), {1}, context, SKELETAL_ABOVE)
    settings = mapping.mapper_options()
    settings.image_names = [ImageRef("cam", frame).name for frame in range(3)]
    models, _ = reconstruct(earlier, settings, context, 3)
    write_models(earlier, models)
    repair = {"contradicted_share": contradicted}
    diagnostics = MapDiagnostics(details={"keyframes": KEYFRAMES, "repair": repair})
    first = make_result(models, earlier, diagnostics.to_log())
    assert [item.keyframe_frame.tolist() for item in first.maps] == [[0, 1, 2]]
    result = extend_map(capture, first, {}, MapOptions(), context)
    frames = [sorted(item.keyframe_frame.tolist()) for item in result.maps]
    if contradicted:
        assert frames == [[0, 1, 2]]
        assert result.diagnostics.misplaced == {}
    else:
        assert frames == [list(range(3, KEYFRAMES)), [0, 1, 2]]
        assert result.diagnostics.misplaced == {"cam": (0, 1, 2)}


def test_only_cameras_with_more_keyframes_in_the_larger_model_are_displaced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def model(**counts: int) -> Any:
        names = {ImageRef(name, frame).name for name, count in counts.items() for frame in range(count)}
        images = dict(enumerate(sorted(names)))
        return SimpleNamespace(
            num_reg_images=lambda: len(images),
            num_points3D=lambda: 100,
            reg_image_ids=lambda: list(images),
            image=lambda number: SimpleNamespace(name=images[number]),
        )

    first, found = model(head=4, palm=2), model(palm=8)
    monkeypatch.setattr(unmapped_keyframes, "reconstruct_unmapped", lambda *_: [found])
    rest = {ImageRef("palm", frame).name for frame in range(20, 30)}
    inside = keyframe_names(first)
    models, displaced = with_larger_model([first], inside | rest, 0.0, cast(Any, None))
    assert models == [found, first]
    # The head keeps its map: all of its keyframes are in the first model.
    assert displaced == {ImageRef("palm", 0).name, ImageRef("palm", 1).name}
    assert with_larger_model([found], keyframe_names(found) | rest, 0.0, cast(Any, None))[0] == [found]


@pytest.mark.parametrize("turned_from", [None, 11])
def test_keyframes_after_a_turn_that_the_map_does_not_show_are_not_in_it(
    turned_from: int | None, tmp_path: Path
) -> None:
    """The matches agree along the whole wall, as in a room with identical bays."""
    earlier, work = tmp_path / "earlier", tmp_path / "work"
    earlier.mkdir()
    work.mkdir()
    rotations = write_wall(earlier)[:, :3, :3]
    if turned_from is not None:
        rotations[turned_from:] = so3_exp([0.0, np.pi / 2, 0.0]) @ rotations[turned_from:]
    context = StageContext(work_dir=work, threads=2)
    match_frames(earlier, range(KEYFRAMES), context)
    chain = RotationChain(
        frames=np.arange(KEYFRAMES),
        turns=so3_log(rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2)),
        sigma_rad=np.full(KEYFRAMES - 1, 1e-3),
        turn_sigma=0.05,
    )
    capture = Capture(cameras=(replace(CAMERA, rotation_chain=chain),))
    previous = MapResult(maps=(small_map(),), workspace=earlier, log={})
    result = map_lost_keyframes(capture, previous, [NOTHING_POSED], MapOptions(), context)
    (further,) = result.maps[1:]
    assert sorted(further.keyframe_frame.tolist()) == list(range(turned_from or KEYFRAMES))
