"""Keypoints of rolling shutters are moved in the database, and kept as detected for everything else."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.intrinsics import shutters
from bodycap_batch.mapping.intrinsics.readout_time import Readout, judged_readout
from bodycap_batch.mapping.intrinsics.shutters import (
    known_readouts,
    possible_readouts,
    read_shutters,
    readouts_of_maps,
    turning_shutters,
    uncorrected_shutters,
    write_shutters,
)
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    read_detected_px,
    read_image_ids,
    read_keypoint_colours,
    rewrite_without_cameras,
)
from bodycap_batch.mapping.matching.keyframe_features import CameraKeyframes, add_keyframes
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.frame_matches import FrameMatcher, FrameMatches
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.optical_flow import make_coarse_image
from bodycap_batch.model.rotation_path import RotationPath, TurningShutter

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([400.0, 400.0, 320.0, 240.0]))
READOUT_S = 0.02
RATE = 1.5
"""Turn about the vertical axis, rad/s."""


def _wall() -> np.ndarray:
    """Return a wall (480,1600) of irregular blots."""
    rng = np.random.default_rng(5)
    wall = np.full((480, 1600), 120, np.uint8)
    for x, y, shade in zip(
        rng.integers(0, 1600, 700), rng.integers(0, 480, 700), rng.integers(0, 255, 700), strict=True
    ):
        corners = np.add(rng.integers(-28, 28, (4, 2)), (x, y))
        cv2.fillPoly(wall, [corners.astype(np.int32)], int(shade))
    return np.asarray(cv2.GaussianBlur(wall, (0, 0), 1.5), np.uint8)


WALL = _wall()


def _picture(frame: int, step_px: int = 60) -> np.ndarray:
    left = 100 + step_px * frame
    return np.ascontiguousarray(WALL[:, left : left + 640])


class _Pan:
    """A camera that pans along the wall."""

    shows_only_room = True

    def __init__(self, name: str) -> None:
        self.name = name

    def is_unmasked(self, px: np.ndarray, frame: int | None = None) -> np.ndarray:
        return np.ones(len(px), dtype=bool)

    def read(self, frames: np.ndarray, *, colour: bool) -> Any:
        assert colour
        for frame in map(int, frames):
            yield frame, np.repeat(_picture(frame)[..., None], 3, axis=2).copy()


def _shutter(rate: float = RATE, readout_s: float = READOUT_S) -> TurningShutter:
    """A shutter of a camera that turns to the right at a constant rate (rad/s)."""
    times = np.arange(6) * 33_333_333
    step = np.tile(so3_exp([0.0, -rate / 30, 0.0]), (5, 1, 1))
    path = RotationPath.from_steps(times, step, np.ones(5, bool))
    return TurningShutter(LENS, path, readout_s)


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A database with a camera with a rolling shutter and one with a global shutter."""
    with pycolmap.Database.open(str(tmp_path / DATABASE_NAME)) as database:
        for number in (1, 2):
            assert database.write_camera(LENS.to_pycolmap()) == number
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
            database.write_rig(rig)
    pans = [cast(CaptureCamera, _Pan(name)) for name in ("fixed", "rolling")]
    keyframes = [
        CameraKeyframes(pans[0], 1, np.array([0, 3])),
        CameraKeyframes(pans[1], 2, np.array([0, 3]), shutter=_shutter()),
    ]
    add_keyframes(tmp_path, keyframes, MapOptions(), StageContext(work_dir=tmp_path, threads=1))
    return tmp_path


def _keypoints(workspace: Path) -> dict[str, tuple[int, np.ndarray]]:
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        return {
            ref.name: (number, np.asarray(database.read_keypoints(number))[:, :2])
            for ref, number in ids.items()
        }


def test_keypoints_are_at_one_instant_and_the_detected_positions_are_kept(workspace: Path) -> None:
    found = _keypoints(workspace)
    for frame in (0, 3):
        _, fixed = found[f"fixed/{frame:07d}"]
        number, moved = found[f"rolling/{frame:07d}"]
        detected = read_detected_px(workspace, number)
        assert detected is not None
        assert np.array_equal(detected, fixed)
        # In the middle of the image, a row at the edge moves by half a readout: 1.5 rad/s · 10 ms · 400 px.
        shift = moved - fixed
        row = fixed[:, 1] / 480.0 - 0.5
        middle = (abs(fixed[:, 0] - 320.0) < 60.0) & (abs(row) > 0.2)
        assert shift[middle, 0] == pytest.approx(row[middle] * READOUT_S * RATE * 400.0, rel=0.05)
        assert abs(shift[:, 1]).max() < 3.0
    number, _ = found["fixed/0000000"]
    assert read_detected_px(workspace, number) is None


def test_a_camera_that_is_left_out_takes_its_files_along(workspace: Path) -> None:
    before = _keypoints(workspace)
    rewrite_without_cameras(workspace, {"fixed"})
    after = _keypoints(workspace)
    assert sorted(after) == ["rolling/0000000", "rolling/0000003"]
    for name, (number, px) in after.items():
        assert np.array_equal(px, before[name][1])
        detected = read_detected_px(workspace, number)
        assert detected is not None
        assert len(detected) == len(px) == len(read_keypoint_colours(workspace, number))
        assert np.array_equal(detected, before[name.replace("rolling", "fixed")][1])


def test_shutters_of_a_workspace_are_read_again(tmp_path: Path) -> None:
    write_shutters(tmp_path, {"rolling": _shutter()})
    found = read_shutters(tmp_path, ["fixed", "rolling"])
    assert sorted(found) == ["rolling"]
    px = np.array([[100.0, 20.0], [500.0, 470.0]])
    at = np.array([2, 2])
    assert np.allclose(found["rolling"].px_at_mid_row(at, px), _shutter().px_at_mid_row(at, px), atol=1e-9)
    assert read_shutters(tmp_path / "none", ["rolling"]) == {}


def test_only_cameras_with_a_rolling_shutter_get_one() -> None:
    def camera(name: str, seconds: float, *, known: bool) -> Any:
        return SimpleNamespace(
            name=name,
            camera=LENS,
            times_ns=np.arange(6) * 33_333_333,
            rolling_shutter_s=seconds,
            rolling_shutter_known=known,
        )

    cameras = {
        each.name: each
        for each in (
            camera("head", 0.02, known=True),
            camera("hips", 0.0, known=True),
            camera("torso", 0.0, known=False),
        )
    }
    capture: Any = SimpleNamespace(cameras=tuple(cameras.values()), camera=lambda name: cameras[name])
    readouts = known_readouts(capture)
    assert {name: each.seconds for name, each in readouts.items()} == {"head": 0.02}
    px = np.array([[100.0, 100.0], [400.0, 300.0]], np.float32)
    matches = FrameMatches(camera="head", frame=np.zeros(2, np.int64), first_px=px, second_px=px)
    selections: Any = [
        SimpleNamespace(camera="head", gyro=None, matches=matches),
        SimpleNamespace(camera="hips", gyro=None, matches=None),
        SimpleNamespace(camera="torso", gyro=None, matches=matches),
    ]
    readouts["torso"] = Readout(0.0, 0.01, "none found", 0.0)
    assert list(turning_shutters(capture, selections, readouts)) == ["head"]


def test_a_shutter_that_may_roll_is_uncorrected_if_no_keypoint_was_moved() -> None:
    stated_s = {"head": 0.0, "chest": 0.02}
    names = ("head", "chest", "hips", "torso", "left_palm", "right_palm", "still")
    cameras = [
        SimpleNamespace(
            name=name, rolling_shutter_known=name in stated_s, rolling_shutter_s=stated_s.get(name, 0.0)
        )
        for name in names
    ]
    capture: Any = SimpleNamespace(cameras=cameras)
    readouts = {
        "hips": judged_readout(0.0, 0.0005),
        "torso": judged_readout(0.01, 0.0005),
        "left_palm": judged_readout(0.003, 0.0027),
        "still": judged_readout(0.01, 0.0005),
    }
    found = uncorrected_shutters(capture, readouts, {"torso"})
    assert found == ("chest", "left_palm", "right_palm", "still")


def test_a_camera_that_turns_fast_may_have_a_short_readout_time(monkeypatch: pytest.MonkeyPatch) -> None:
    readouts = {
        "calm": judged_readout(0.0003, 0.0008),
        "fast": judged_readout(0.0003, 0.0008),
        "exact": judged_readout(0.0003, 0.0001),
        "rolling": judged_readout(0.01, 0.0005),
        "unknown": judged_readout(0.003, 0.0027),
        "negative": judged_readout(-0.0003, 0.0008),
        "turned": judged_readout(0.0003, 0.0008),
        "calm, like fast": judged_readout(0.0003, 0.0008),
    }
    rates = {name: 0.5 if name.startswith("calm") else 15.0 for name in readouts}

    def shutters_of(_: object, __: object, trial: dict[str, Readout]) -> dict[str, TurningShutter]:
        return {name: _shutter(rates[name], item.seconds) for name, item in trial.items()}

    monkeypatch.setattr(shutters, "turning_shutters", shutters_of)
    monkeypatch.setattr(
        shutters,
        "groups_of_equal_cameras",
        lambda _: [["fast", "calm, like fast"], *([name] for name in rates if "fast" not in name)],
    )
    selections: Any = [SimpleNamespace(camera=name, frames=np.arange(1, 5)) for name in rates]
    cameras = {name: SimpleNamespace(may_be_sideways=name == "turned") for name in rates}
    capture: Any = SimpleNamespace(camera=cameras.__getitem__, cameras=())
    possible = possible_readouts(capture, selections, readouts)
    # The largest plausible readout time is 1.9 ms. Until the first row, a fast camera turns by 14 mrad.
    assert {name: item.seconds for name, item in possible.items()} == {
        "fast": 0.0003,
        "calm, like fast": 0.0003,
        "negative": -0.0003,
    }
    assert possible["fast"].sigma_s == 0.0008


def test_the_readouts_of_corrected_maps_are_used_for_their_extension() -> None:
    maps: Any = [
        SimpleNamespace(readout_s={"head": 0.02}, readout_sigma_s={"head": 0.001}, cameras={"head": LENS}),
        SimpleNamespace(
            readout_s={"head": 0.02, "torso": 0.01}, readout_sigma_s={"head": 0.001}, cameras={"head": LENS}
        ),
    ]
    found = readouts_of_maps(maps)
    assert {name: (each.seconds, each.sigma_s) for name, each in found.items()} == {
        "head": (0.02, 0.001),
        "torso": (0.01, 0.0),
    }


@pytest.mark.parametrize("step_px", [20, 200])
def test_adjacent_frames_are_matched_also_where_optical_flow_fails(step_px: int) -> None:
    matcher = FrameMatcher("head", 640)
    for frame in (0, 1, 3):
        matcher.add(frame, make_coarse_image(_picture(frame, step_px)))
    found = matcher.matches()
    assert found is not None
    assert set(found.frame.tolist()) == {0}  # frame 2 was not read, so frame 3 has no neighbour
    shift = found.second_px - found.first_px
    right = np.linalg.norm(shift - (-step_px, 0.0), axis=1) < 2.0
    assert right.sum() >= 20
    assert right.mean() > 0.5


def test_a_matcher_that_is_not_enabled_finds_nothing() -> None:
    matcher = FrameMatcher("head", 640, enabled=False)
    matcher.add(0, make_coarse_image(_picture(0)))
    matcher.add(1, make_coarse_image(_picture(1)))
    assert matcher.matches() is None
