"""Further maps of lost keyframes hold no pairs that the rotation of the video contradicts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping import map_lost_keyframes
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.matching.pair_matching import match_pairs
from bodycap_batch.model.geometry import so3_exp, so3_log
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
    refs = [ImageRef("cam", frame) for frame in range(KEYFRAMES)]
    pairs = [(a, b) for a in refs for b in refs if a < b and b.frame - a.frame <= 5]
    context = StageContext(work_dir=work, threads=2)
    chain = RotationChain(
        frames=np.arange(KEYFRAMES),
        turns=so3_log(rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2)),
        sigma_rad=np.full(KEYFRAMES - 1, 1e-3),
        turn_sigma=0.05,
    )
    match_pairs(earlier, pairs, {"cam": CameraIntrinsics(LENS, True, chain, CAMERA.times_ns)}, context)
    capture = Capture(cameras=(replace(CAMERA, rotation_chain=chain),))
    previous = MapResult(maps=(small_map(),), workspace=earlier, log={})
    result = map_lost_keyframes(capture, previous, [NOTHING_POSED], MapOptions(), context)
    (further,) = result.maps[1:]
    assert sorted(further.keyframe_frame.tolist()) == list(range(turned_from or KEYFRAMES))
