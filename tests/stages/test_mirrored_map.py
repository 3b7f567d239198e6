"""Maps of captures with a flipped picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config import KeyframeOptions, MapOptions
from bodycap_batch.config.job import load_job
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping import build, build_map
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes
from bodycap_batch.model.scene import KeyframeSelection
from tests.rooms import stroll, write_capture
from tests.stages.conftest import context
from tests.videos import write_video

FRAMES = 40


@pytest.fixture(scope="module")
def flipped_capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Three cameras; the palm's picture is flipped."""
    folder = tmp_path_factory.mktemp("flipped")
    paths = stroll(FRAMES)
    head = paths["torso"].copy()
    head[:, 2, 3] += 0.4
    capture = write_capture(folder, {**paths, "head": head})
    images = [image for _, image in capture.camera("left_palm").read(np.arange(FRAMES), colour=False)]
    write_video(folder / "left_palm.mp4", [np.ascontiguousarray(image[:, ::-1]) for image in images])
    return open_capture(load_job(folder).capture)


@pytest.fixture(scope="module")
def selections(
    flipped_capture: Capture, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, KeyframeSelection]:
    """Its keyframes by camera."""
    work = tmp_path_factory.mktemp("keyframes")
    return {
        camera.name: select_keyframes(camera, KeyframeOptions(), context(work / camera.name))
        for camera in flipped_capture.cameras
    }


def _without(capture: Capture, name: str) -> Capture:
    return replace(capture, cameras=tuple(each for each in capture.cameras if each.name != name))


def test_the_map_is_the_same_as_without_the_flipped_camera(
    flipped_capture: Capture,
    selections: dict[str, KeyframeSelection],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    extracted: list[str] = []
    add = build.add_keyframes

    def counted(workspace: Path, keyframes: Sequence[CameraKeyframes], *rest: Any) -> None:
        new = [item for item in keyframes if item.earlier is None]
        extracted.extend(f"{item.camera.name}:{frame}" for item in new for frame in item.frames)
        add(workspace, keyframes, *rest)

    monkeypatch.setattr(build, "add_keyframes", counted)
    options = MapOptions(init_frames=("left_palm:3", "torso:20"))
    found = build_map(flipped_capture, list(selections.values()), options, context(tmp_path / "all"))
    assert found.diagnostics.flipped_cameras == ("left_palm",)
    assert len(extracted) == len(set(extracted)) == sum(len(each.frames) for each in selections.values())
    straight = [each for each in selections.values() if each.camera != "left_palm"]
    alone = build_map(
        _without(flipped_capture, "left_palm"), straight, MapOptions(), context(tmp_path / "two")
    )
    assert found.maps[0].gauge == alone.maps[0].gauge
    assert np.array_equal(found.maps[0].points, alone.maps[0].points)
    # Readouts come from matches before it is known that a video is mirrored; equal cameras share them.
    same = set(alone.log) - {"readouts_from_matches"}
    assert {key: found.log[key] for key in same} == {key: alone.log[key] for key in same}


def test_two_cameras_that_see_mirror_images_get_a_map_each(
    flipped_capture: Capture, selections: dict[str, KeyframeSelection], tmp_path: Path
) -> None:
    two = [each for each in selections.values() if each.camera != "head"]
    found = build_map(_without(flipped_capture, "head"), two, MapOptions(), context(tmp_path))
    assert found.diagnostics.undecided_groups == ((("left_palm",), ("torso",)),)
    assert not found.diagnostics.flipped_cameras
    assert [set(each.keyframe_camera) for each in found.maps] in (
        [{"left_palm"}, {"torso"}],
        [{"torso"}, {"left_palm"}],
    )
