"""The covariances of poses contain the error of the map around their frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.registration.poses.map_error import with_map_error, without_map_error
from tests.scenes import small_map


def _path(scene: Map, camera: str, count: int) -> Trajectory:
    """Return a trajectory in the gauge of a map; its third frame has no pose."""
    poses, covariance = np.tile(np.eye(4), (count, 1, 1)), np.tile(1e-6 * np.eye(6), (count, 1, 1))
    poses[2], covariance[2] = np.nan, np.nan
    return Trajectory(
        camera=camera,
        gauge=scene.gauge,
        frame_numbers=np.arange(count),
        times_ns=np.arange(count) * 10**8,
        gauge_from_cam=poses,
        covariance=covariance,
        status=tuple(FrameStatus.BLUR if frame == 2 else FrameStatus.REGISTERED for frame in range(count)),
        inliers=np.full(count, 50),
        error_px=np.full(count, 0.5),
    )


def _with_covariance(scene: Map) -> Map:
    sizes = 1e-6 * (1.0 + np.arange(len(scene.keyframe_camera)))
    return replace(scene, keyframe_covariance=sizes[:, None, None] * np.eye(6))


def test_a_frame_has_the_error_of_the_keyframes_around_it() -> None:
    scene = _with_covariance(small_map())
    camera = scene.keyframe_camera[0]
    rows = scene.keyframes_of(camera)
    first, second = scene.keyframe_frame[rows[:2]].tolist()
    count = int(scene.keyframe_frame[rows].max()) + 10
    path = _path(scene, camera, count)
    added = (with_map_error(path, [scene]).covariance - path.covariance)[:, 0, 0]
    stated = scene.keyframe_covariance[rows, 0, 0]
    place = (first + 1 - first) / (second - first)
    np.testing.assert_allclose(added[first], stated[0])
    np.testing.assert_allclose(added[first + 1], (1 - place) * stated[0] + place * stated[1])
    np.testing.assert_allclose(added[-1], stated[-1])
    assert np.isnan(added[2])


def test_the_error_of_the_map_can_be_removed_again() -> None:
    scene = _with_covariance(small_map())
    path = _path(scene, scene.keyframe_camera[0], 30)
    back = without_map_error(with_map_error(path, [scene]), [scene])
    np.testing.assert_allclose(back.covariance, path.covariance, rtol=1e-9, atol=1e-15)


def test_a_map_in_another_gauge_or_without_covariances_changes_nothing() -> None:
    scene = small_map()
    path = _path(scene, scene.keyframe_camera[0], 30)
    for maps in ([], [scene], [replace(_with_covariance(scene), gauge="other")]):
        np.testing.assert_array_equal(with_map_error(path, maps).covariance, path.covariance)
