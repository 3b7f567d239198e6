"""Lost frames are found again near the poses of an inertial sensor, by their own pictures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bodycap_batch.config import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Trajectory
from bodycap_batch.registration.recovery import sensor_search
from bodycap_batch.registration.recovery.recover import RecoveryInputs, make_localiser
from bodycap_batch.registration.recovery.sensor_search import search_near_sensor
from bodycap_batch.telemetry.streams import CameraTelemetry
from tests.stages.test_recovery import (  # the fixtures are used by their names
    COUNT,
    LOST,
    PATH,
    _map,
    _SolvedVideo,
    _tracked,
    context,
    pictures,
)

__all__ = ["context", "pictures"]
SIGMA_RAD, SIGMA_M = np.radians(0.5), 0.06
SHUTTER_RAD = 0.005


def sensor_path(path: Trajectory, off_m: float) -> Trajectory:
    """Return a trajectory in which a sensor filled the lost frames with poses that are off."""
    rng = np.random.default_rng(8)
    rows = np.array(LOST)
    poses, covariance, status = path.gauge_from_cam.copy(), path.covariance.copy(), list(path.status)
    off = make_transform(
        so3_exp(rng.normal(0.0, SIGMA_RAD, (len(rows), 3))), np.tile([off_m, 0.0, 0.0], (len(rows), 1))
    )
    poses[rows] = PATH[rows] @ off
    covariance[rows] = np.diag(np.repeat([SIGMA_RAD**2, SIGMA_M**2], 3))
    for row in rows.tolist():
        status[row] = FrameStatus.INERTIAL
    return replace(path, gauge_from_cam=poses, covariance=covariance, status=tuple(status))


def searched(
    shown: list[np.ndarray],
    off_m: float,
    context: StageContext,
    monkeypatch: pytest.MonkeyPatch,
    shutter: Any = None,
) -> Trajectory:
    before = _tracked()
    filled = SimpleNamespace(trajectory=sensor_path(before.trajectory, off_m))
    monkeypatch.setattr(sensor_search, "use_sensor", lambda *_: filled)
    monkeypatch.setattr(
        sensor_search, "make_localiser", lambda *each: replace(make_localiser(*each), shutter=shutter)
    )
    video = _SolvedVideo(shown)
    capture: Any = SimpleNamespace(cameras=(video,), camera=lambda _: video)
    selection = KeyframeSelection(
        camera="torso", frames=np.array([0]), frame_count=COUNT, sharpness=np.ones(COUNT), noise_px=0.2
    )
    scene = _map(shown)
    inputs = RecoveryInputs(
        capture=capture, registrations=(), maps=[scene], selection=selection, in_rig=False
    )
    return search_near_sensor(before, inputs, CameraTelemetry(), RegistrationOptions(), context).trajectory


def test_frames_are_found_near_the_poses_of_the_sensor(
    pictures: list[np.ndarray], context: StageContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = searched(pictures, 0.05, context, monkeypatch)
    found = [frame for frame in LOST if path.status[frame] is FrameStatus.REGISTERED]
    assert len(found) >= len(LOST) // 2
    off_m = np.linalg.norm(path.gauge_from_cam[:, :3, 3] - PATH[:, :3, 3], axis=1)[found]
    assert off_m.max() < 0.04  # the sensor is 0.05 m off, with an equal sigma


class _ExtrapolatedShutter:
    """A rolling shutter in whose frames the angular velocity is extrapolated."""

    path = SimpleNamespace(is_known=lambda _: False)

    def uncertainty(self, _: int) -> float:
        return SHUTTER_RAD


def test_the_covariance_of_a_found_pose_contains_the_error_of_the_shutter(
    pictures: list[np.ndarray], context: StageContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    without = searched(pictures, 0.05, context, monkeypatch)
    monkeypatch.undo()
    shutter = _ExtrapolatedShutter()
    path = searched(pictures, 0.05, context, monkeypatch, shutter)
    found = [frame for frame in LOST if path.localised[frame]]
    assert len(found) >= len(LOST) // 2
    added = (path.covariance - without.covariance)[found]
    np.testing.assert_allclose(added[:, [0, 1, 2], [0, 1, 2]], SHUTTER_RAD**2, rtol=1e-6)
    # The walls of the room are between 1 and 4 m from the camera.
    assert ((added[:, 3, 3] > SHUTTER_RAD**2) & (added[:, 3, 3] < (4.0 * SHUTTER_RAD) ** 2)).all()


def test_poses_that_contradict_the_sensor_are_not_accepted(
    pictures: list[np.ndarray], context: StageContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = searched(pictures, 0.8, context, monkeypatch)
    off_m = np.linalg.norm(path.gauge_from_cam[:, :3, 3] - PATH[:, :3, 3], axis=1)
    assert not path.localised[list(LOST)].any() or np.nanmax(off_m) < 0.05


def test_the_sensors_of_other_cameras_help(
    pictures: list[np.ndarray], context: StageContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Vertical and scale come from all cameras, since a camera with many lost frames has neither."""
    path, given = _tracked().trajectory, []

    def used(*arguments: Any) -> Any:
        given.append(list(arguments[3]))
        return SimpleNamespace(trajectory=path)

    monkeypatch.setattr(sensor_search, "use_sensor", used)
    inputs: Any = SimpleNamespace(maps=[_map(pictures)])
    other = (path, CameraTelemetry())
    options = RegistrationOptions()
    search_near_sensor(_tracked(), inputs, CameraTelemetry(), options, context, [other])
    assert given == [[other]]


def test_frames_without_texture_stay_lost(
    pictures: list[np.ndarray], context: StageContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = [np.full_like(each, 90) if n in LOST else each for n, each in enumerate(pictures)]
    path = searched(shown, 0.0, context, monkeypatch)
    assert not path.localised[list(LOST)].any()
    assert path.status == _tracked().trajectory.status
