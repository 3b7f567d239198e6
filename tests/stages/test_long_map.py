"""A map of very many keyframes: built from some of them, the others placed in it."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.geometry import align_points
from bodycap_batch.mapping import build_map
from bodycap_batch.scene import KeyframeSelection, MapResult
from tests.rooms import stroll
from tests.stages.conftest import DARK, FRAMES, context

_EVERY = [frame for frame in range(0, FRAMES, 2) if frame not in DARK]


@pytest.fixture(scope="module")
def result(stroll_capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> MapResult:
    """The stroll's map, as of a capture of more than 40 keyframes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bodycap_batch.mapping.pairs._FEW", 10)
        return build_map(
            stroll_capture,
            [_selection(camera.name) for camera in stroll_capture.cameras],
            MapOptions(),
            context(tmp_path_factory.mktemp("long")),
            many=40,
        )


def _selection(name: str) -> KeyframeSelection:
    return KeyframeSelection(
        camera=name,
        frames=np.array(_EVERY),
        frame_count=FRAMES,
        sharpness=np.ones(FRAMES),
        noise_px=0.3,
    )


def test_some_carry_the_map_and_all_others_are_placed_in_it(result: MapResult) -> None:
    told = result.log["placed"]
    count = 2 * len(_EVERY)
    assert told["carrying"] + told["placed"] == len(result.maps[0].keyframe_camera) == count
    assert told["carrying"] < 0.8 * count


def test_who_was_placed_stands_as_right_as_who_carries(result: MapResult) -> None:
    found = result.maps[0]
    mine = found.map_from_cam[:, :3, 3]
    poses = stroll(FRAMES)
    pairs = zip(found.keyframe_camera, found.keyframe_frame.tolist(), strict=True)
    true = np.array([poses[camera][frame][:3, 3] for camera, frame in pairs])
    off = np.linalg.norm(align_points(mine, true).apply(mine) - true, axis=1)
    # A quarter of a pixel at 3 m and 240 px is 3 mm a point; a pose has dozens, not all well spread.
    assert np.sqrt((off**2).mean()) < 0.01
    assert off.max() < 0.03
