"""Far points: those whose depth the pictures hardly determine, outside of all that they determine well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.far_points import depth_sigma, is_far
from bodycap_batch.formats.ply import read_ply
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.scene import Map

FOCAL_PX, SIGMA_PX, BASELINE = 500.0, 0.8, 1.0


def seen_by_two(points: FloatArray, scale: float = 1.0) -> Map:
    """Return a map of two cameras at a distance of 1 that see all points, with errors of 0.8 px."""
    count = len(points)
    lens = Camera(
        model="SIMPLE_PINHOLE", width_px=640, height_px=480, params=np.array([FOCAL_PX, 320.0, 240.0])
    )
    centres = scale * BASELINE * np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    return Map(
        gauge="map-0",
        cameras={"torso": lens},
        keyframe_camera=("torso", "torso"),
        keyframe_frame=np.array([0, 9]),
        map_from_cam=make_transform(np.tile(np.eye(3), (2, 1, 1)), centres),
        points=scale * points,
        colors=np.full((count, 3), 90, dtype=np.uint8),
        point_error_px=np.full(count, SIGMA_PX),
        obs_keyframe=np.repeat([0, 1], count),
        obs_point=np.tile(np.arange(count), 2),
        obs_feature=np.tile(np.arange(count), 2),
        obs_px=np.zeros((2 * count, 2)),
    )


def room() -> FloatArray:
    rng = np.random.default_rng(4)
    wall = rng.uniform([-2.0, -1.0, 3.0], [2.0, 1.0, 4.0], size=(200, 3))
    return np.concatenate([wall, [[1.0, 0.5, 60.0], [0.0, 0.3, 40.0], [0.4, 0.0, 9.0]]])


def test_the_sigma_is_that_of_stereo() -> None:
    """For two cameras side by side, the depth z has the sigma z² σ √2 / (f b) to first order."""
    depth = np.array([5.0, 10.0, 20.0])
    points = np.stack([np.zeros(3), np.zeros(3), depth], axis=1)
    sigma, distance = depth_sigma(seen_by_two(points))
    expected = depth**2 * SIGMA_PX * np.sqrt(2.0) / (FOCAL_PX * BASELINE)
    np.testing.assert_allclose(sigma, expected, rtol=0.02)  # the rays are not quite parallel
    np.testing.assert_allclose(distance, np.hypot(depth, 0.5))


def test_far_points_are_those_with_an_uncertain_depth() -> None:
    for scale in (1.0, 0.01, 300.0):  # the unit of a map is arbitrary
        far = is_far(seen_by_two(room(), scale))
        assert np.flatnonzero(far).tolist() == [200, 201]


def test_an_uncertain_point_inside_the_room_stays() -> None:
    """It does not hide the room, and the room is full of points that were seen from one place."""
    scene = seen_by_two(room())
    near_one_place = np.isin(scene.obs_point, [0, 1]) & (scene.obs_keyframe == 1)
    scene = replace(
        scene,
        **{
            name: getattr(scene, name)[~near_one_place]
            for name in ("obs_keyframe", "obs_point", "obs_feature", "obs_px")
        },
    )
    sigma, _ = depth_sigma(scene)
    assert np.isinf(sigma[:2]).all() or (sigma[:2] > 1e3).all()
    assert np.flatnonzero(is_far(scene)).tolist() == [200, 201]


def test_a_map_without_certain_points_is_kept() -> None:
    scene = seen_by_two(room())
    blurred = replace(scene, point_error_px=np.full(len(scene.points), 300.0))
    assert not is_far(blurred).any()
    empty = seen_by_two(np.zeros((0, 3)))
    assert is_far(empty).tolist() == []


def test_far_points_have_a_file_of_their_own(tmp_path: Path) -> None:
    inputs = ExportInputs(out_dir=tmp_path, maps=(seen_by_two(room()),), trajectories=(), clocks={})
    written = export_results(inputs, ExportOptions(formats=("ply",)), StageContext(work_dir=tmp_path))
    assert {"map.ply", "map_far.ply"} <= {path.name for path in written}
    near, far = (read_ply(tmp_path / name).points for name in ("map.ply", "map_far.ply"))
    assert sorted(far[:, 2].tolist()) == [40.0, 60.0]
    assert len(near) == 201
