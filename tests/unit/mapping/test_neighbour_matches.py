"""Keyframes get as many features, and neighbours as near, as their matching needs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core import mechanisms
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.matching import neighbour_matches
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef, read_image_ids, read_tracks
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.mapping.matching.neighbour_matches import MORE_FEATURES, features_for_neighbours
from bodycap_batch.mapping.matching.pair_matching import KeyframeFeatures, common_tracks, match_pairs
from bodycap_batch.model.camera import Camera

WIDTH, HEIGHT, FRAMES, COUNT = 480, 360, 25, 128
LENS = Camera(
    model="PINHOLE", width_px=WIDTH, height_px=HEIGHT, params=np.array([400.0, 400.0, WIDTH / 2, HEIGHT / 2])
)
LENS_KNOWN = CameraIntrinsics(LENS, calibrated=True)


class Pan:
    """A camera that moves along a textured wall by a constant number of pixels a frame."""

    name, mask, camera, calibrated = "torso", None, LENS, True

    def __init__(self, step_px: float, *, plain: bool = False) -> None:
        self.step_px = step_px
        self.read_frames: list[int] = []
        noise = np.random.default_rng(4).uniform(0, 255, (120, 1000)).astype(np.float32)
        self.wall = cv2.resize(noise, (4000, 480), interpolation=cv2.INTER_CUBIC).clip(0, 255)
        if plain:
            self.wall[:] = 128.0

    def is_unmasked(self, px: np.ndarray) -> np.ndarray:
        return np.ones(len(px), dtype=bool)

    def read_decodable(self, frames: np.ndarray) -> Any:
        for frame, rgb in self.read(frames, colour=True):
            yield frame, rgb[:, :, 0]

    def read(self, frames: np.ndarray, *, colour: bool) -> Any:
        assert colour
        for frame in frames.tolist():
            self.read_frames.append(frame)
            moved = np.array([[1.0, 0.0, -self.step_px * frame], [0.0, 1.0, -20.0]])
            grey = cv2.warpAffine(self.wall, moved, (WIDTH, HEIGHT)).astype(np.uint8)
            yield frame, np.repeat(grey[:, :, None], 3, axis=2)


def found(camera: Pan, folder: Path, keyframes: list[int]) -> dict[int, int]:
    """Return the number of features of each keyframe."""
    sharpness = np.ones(FRAMES)
    sharpness[11] = 2.0
    sharpness[12] = np.nan
    context = StageContext(work_dir=folder, threads=1)
    features = features_for_neighbours(
        cast(CaptureCamera, camera), np.array(keyframes), sharpness, COUNT, context
    )
    return {frame: len(each.keypoints) for frame, each in features.items()}


def test_neighbours_with_many_matches_are_left_alone(tmp_path: Path) -> None:
    camera = Pan(1.0)
    assert max(found(camera, tmp_path, [0, 12, 24]).values()) <= COUNT
    assert camera.read_frames == [0, 12, 24]


def test_neighbours_with_few_matches_get_more_features_and_a_frame_between_them(tmp_path: Path) -> None:
    camera = Pan(18.0)
    counts = found(camera, tmp_path, [0, 24])
    assert next(iter(counts)) == 0
    assert list(counts)[-1] == 24
    assert 11 in counts, "the sharpest frame of the middle third that can be a keyframe"
    assert 12 not in counts
    assert counts[0] > COUNT
    assert max(counts.values()) <= MORE_FEATURES * COUNT
    assert list(counts) == sorted(counts)


def test_a_plain_wall_does_not_get_more_keyframes(tmp_path: Path) -> None:
    camera = Pan(18.0, plain=True)
    assert found(camera, tmp_path, [0, 24]) == {0: 0, 24: 0}
    assert camera.read_frames == [0, 24]


@pytest.mark.parametrize("step_px", [18.0])
def test_nothing_is_added_if_the_mechanism_is_switched_off(step_px: float, tmp_path: Path) -> None:
    mechanisms.begin_task({mechanisms.KEY_OPTION: ["neighbour_matches"]})
    try:
        camera = Pan(step_px)
        assert max(found(camera, tmp_path, [0, 24]).values()) <= COUNT
    finally:
        mechanisms.begin_task({})
    assert camera.read_frames == [0, 24]


def test_neighbours_that_stay_weak_get_the_points_of_optical_flow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(neighbour_matches, "_MIN_MATCHES", 10_000)
    monkeypatch.setattr(neighbour_matches, "_MIN_SHARE", 1.01)
    monkeypatch.setattr(neighbour_matches, "_ROUNDS", 0)
    camera, context = Pan(4.0), StageContext(work_dir=tmp_path, threads=1)
    frames = np.array([0, 6, 12])
    features = features_for_neighbours(cast(CaptureCamera, camera), frames, np.ones(FRAMES), COUNT, context)
    for first, second in pairwise(frames.tolist()):
        one, other = (
            replace(
                KeyframeFeatures.of(each.keypoints[:, :2], each.descriptors, LENS_KNOWN), track=each.track
            )
            for each in (features[first], features[second])
        )
        matches = common_tracks(one, other)
        assert len(matches) > 100
        assert (matches >= len(one.descriptors) - len(one.track)).all(), "tracks follow the SIFT features"
        shift = features[first].keypoints[matches[:, 0], :2] - features[second].keypoints[matches[:, 1], :2]
        assert np.median(np.abs(shift - [4.0 * (second - first), 0.0]), axis=0).max() < 0.2
    every = np.concatenate([each.track for each in features.values()])
    assert (np.unique(every, return_counts=True)[1] > 1).all(), "a point in one keyframe has no match"


def test_tracks_are_stored_and_copied_with_the_features(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(neighbour_matches, "_MIN_MATCHES", 10_000)
    monkeypatch.setattr(neighbour_matches, "_MIN_SHARE", 1.01)
    monkeypatch.setattr(neighbour_matches, "_ROUNDS", 0)
    found = []
    for name, earlier in (("first", None), ("second", tmp_path / "first")):
        folder = tmp_path / name
        folder.mkdir()
        with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
            rig = pycolmap.Rig()
            rig.add_ref_sensor(
                pycolmap.sensor_t(pycolmap.SensorType.CAMERA, database.write_camera(LENS.to_pycolmap()))
            )
            database.write_rig(rig)
        camera = Pan(4.0)
        keyframes = CameraKeyframes(
            cast(CaptureCamera, camera), 1, np.array([0, 6, 12]), np.ones(FRAMES), earlier=earlier
        )
        context = StageContext(work_dir=folder, threads=1)
        add_keyframes(folder, [keyframes], MapOptions(features=COUNT), context)
        with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
            ids = read_image_ids(database)
        found.append([read_tracks(folder, number).tolist() for _, number in sorted(ids.items())])
        assert bool(camera.read_frames) is (earlier is None)
    assert found[0] == found[1]
    assert min(map(len, found[0])) > 100
    refs = [ImageRef("torso", frame) for frame in (0, 6)]
    intrinsics = {"torso": LENS_KNOWN}
    context = StageContext(work_dir=tmp_path, threads=1)
    (count,) = match_pairs(tmp_path / "second", [(refs[0], refs[1])], intrinsics, context).values()
    assert count > COUNT, "more than all SIFT features"


def test_the_search_can_be_stopped(tmp_path: Path) -> None:
    context = SimpleNamespace(threads=1, progress=lambda *_: None, check_cancelled=_stop)
    with pytest.raises(KeyboardInterrupt):
        features_for_neighbours(
            cast(CaptureCamera, Pan(18.0)), np.array([0, 24]), np.ones(FRAMES), COUNT, cast(Any, context)
        )


def _stop() -> None:
    raise KeyboardInterrupt
