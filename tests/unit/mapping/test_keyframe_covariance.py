"""The stated covariances of a map's keyframes are those of its errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pycolmap
import pytest

from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction import keyframe_covariance
from bodycap_batch.mapping.reconstruction.camera_motion import RowMotion
from bodycap_batch.mapping.reconstruction.conversion import map_from_reconstruction, observed_px
from bodycap_batch.mapping.reconstruction.keyframe_covariance import keyframe_covariances
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp, transform_points
from bodycap_batch.model.scene import Map

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
KEYFRAMES, POINTS, NOISE_PX = 8, 90, 0.4


def _scene() -> Map:
    """Keyframes on a bow of 0.9 m that see the same points, 2 to 5 m in front of them; no noise."""
    rng = np.random.default_rng(0)
    steps = np.linspace(-0.5, 0.5, KEYFRAMES)
    turns = so3_exp(np.outer(steps, [0.02, -0.2, 0.05]))
    poses = make_transform(turns, np.column_stack([0.9 * steps, 0.2 * steps**2, 0.1 * np.sin(9.0 * steps)]))
    depth = rng.uniform(2.0, 5.0, POINTS)
    points = np.column_stack(
        [rng.uniform(-0.5, 0.5, POINTS), rng.uniform(-0.4, 0.4, POINTS), np.ones(POINTS)]
    )
    points *= depth[:, None]
    keyframe, point = np.divmod(np.arange(KEYFRAMES * POINTS), POINTS)
    scene = Map(
        gauge="map-0",
        cameras={"torso": LENS},
        keyframe_camera=("torso",) * KEYFRAMES,
        keyframe_frame=10 * np.arange(KEYFRAMES),
        map_from_cam=poses,
        points=points,
        colors=np.zeros((POINTS, 3), np.uint8),
        point_error_px=np.ones(POINTS),
        obs_keyframe=keyframe,
        obs_point=point,
        obs_feature=point,
        obs_px=np.zeros((KEYFRAMES * POINTS, 2)),
    )
    return replace(scene, obs_px=_projected(scene))


def _projected(scene: Map) -> np.ndarray:
    cam_from_map = invert(scene.map_from_cam)[scene.obs_keyframe]
    return LENS.project(transform_points(cam_from_map, scene.points[scene.obs_point]))


def _moved(scene: Map, change: np.ndarray) -> Map:
    """Return the map with other poses (right perturbations of map_from_cam) and other points."""
    pose = change[: 6 * KEYFRAMES].reshape(KEYFRAMES, 6)
    poses = scene.map_from_cam @ make_transform(so3_exp(pose[:, :3]), pose[:, 3:])
    return replace(scene, map_from_cam=poses, points=scene.points + change[6 * KEYFRAMES :].reshape(-1, 3))


@pytest.fixture(scope="module")
def exact() -> tuple[Map, np.ndarray]:
    """Return the map, and the change of its poses and points that noise of its pixels causes (linear)."""
    scene = _scene()
    count, step = 6 * KEYFRAMES + 3 * POINTS, 1e-5
    derivative = np.array(
        [
            (_projected(_moved(scene, each)) - _projected(_moved(scene, -each))).ravel() / (2.0 * step)
            for each in step * np.eye(count)
        ]
    ).T
    # Among all gauges, the pseudo-inverse chooses the one with the least change; points count little here.
    unit = np.concatenate([np.tile(np.repeat([1.0, 3.0], 3), KEYFRAMES), np.full(3 * POINTS, 1e3)])
    return scene, unit[:, None] * np.linalg.pinv(derivative * unit, rcond=1e-9)


def _normalised_errors(exact: tuple[Map, np.ndarray], noise: np.ndarray) -> float:
    """Return the squared errors of the keyframes over their stated covariances, mean over all dimensions."""
    scene, from_noise = exact
    change = from_noise @ noise.ravel()
    adjusted = _moved(scene, change)
    stated = keyframe_covariances(adjusted, scene.obs_px + noise)
    error = change[: 6 * KEYFRAMES].reshape(KEYFRAMES, 6)
    return float(np.mean(np.einsum("ki,kij,kj->k", error, np.linalg.inv(stated), error)) / 6)


def test_the_errors_of_keyframes_are_as_large_as_stated(exact: tuple[Map, np.ndarray]) -> None:
    rng = np.random.default_rng(1)
    errors = [_normalised_errors(exact, rng.normal(0, NOISE_PX, exact[0].obs_px.shape)) for _ in range(40)]
    # The errors of the keyframes of one map are correlated, so 40 maps count as about 40 · 6 draws: ± 10 %;
    # the ratio of common errors, which is at least 1, makes the stated variances some per cent larger.
    assert 0.7 < np.mean(errors) < 1.15


def test_common_errors_of_neighbours_make_keyframes_less_certain(exact: tuple[Map, np.ndarray]) -> None:
    rng = np.random.default_rng(2)
    scene = exact[0]
    cell = np.floor((scene.obs_px - 320.0) / 84.0).astype(int) @ [100, 1] + 10_000 * scene.obs_keyframe
    _, cell = np.unique(cell, return_inverse=True)
    errors = []
    for _ in range(40):
        common = rng.normal(0, NOISE_PX, (cell.max() + 1, 2))[cell]
        errors.append(_normalised_errors(exact, common + rng.normal(0, 0.5 * NOISE_PX, common.shape)))
    # About three points share a cell, with four fifths of their variance. As if all errors were independent,
    # the mean would be more than 2.
    assert 0.6 < np.mean(errors) < 1.6


class _Motion:
    """A camera with a readout time of 10 ms that turns and moves while its rows are exposed."""

    readout_s, interval_s = 0.01, 0.033
    rate, speed = np.array([0.5, -1.5, 0.3]), np.array([0.6, 0.2, -0.4])

    def __init__(self, sigmas: tuple[float, float, float], readout_sigma_s: float) -> None:
        self.sigmas, self.readout_sigma_s = sigmas, readout_sigma_s

    def until_exposure(self, frame: np.ndarray, px: np.ndarray) -> RowMotion:
        delay = (px[:, 1] / LENS.height_px - 0.5) * self.readout_s
        return RowMotion(delay_s=delay, turn=np.outer(delay, self.rate), shift=np.outer(delay, self.speed))

    def errors(self, frame: np.ndarray) -> np.ndarray:
        return np.tile(self.sigmas, (len(frame), 1))


def _seen_while_moving(scene: Map, motion: _Motion, velocities: np.ndarray, readout: float) -> np.ndarray:
    """Return pixels of a moving camera; velocities (K,9) and readout time in units of their sigmas."""
    v = (velocities * np.repeat(motion.sigmas, 3))[scene.obs_keyframe]
    delay = motion.until_exposure(scene.obs_keyframe, scene.obs_px).delay_s[:, None]
    longer = readout * motion.readout_sigma_s / motion.readout_s * delay
    turn = longer * motion.rate + delay * v[:, :3] + 0.5 / motion.interval_s * delay**2 * v[:, 3:6]
    shift = longer * motion.speed + delay * v[:, 6:]
    in_cam = transform_points(invert(scene.map_from_cam)[scene.obs_keyframe], scene.points[scene.obs_point])
    return LENS.project(np.einsum("mij,mj->mi", so3_exp(-turn), in_cam - shift))


def _variances(system: np.ndarray) -> np.ndarray:
    """Return the summed variances (K,) of the keyframes' poses, from all equations (rows with unit noise)."""
    unit = np.concatenate([np.tile(np.repeat([1.0, 3.0], 3), KEYFRAMES), np.full(3 * POINTS, 1e3)])
    unit = np.concatenate([unit, np.ones(system.shape[1] - len(unit))])
    inverse = (unit[:, None] * np.linalg.pinv(system * unit, rcond=1e-9))[: 6 * KEYFRAMES]
    return np.asarray((inverse**2).sum(axis=1).reshape(KEYFRAMES, 6).sum(axis=1))


@pytest.mark.parametrize(
    ("sigmas", "readout_sigma_s", "least"), [((0.5, 5.0, 0.5), 0.0004, 4.0), ((1e-3, 1e-2, 1e-3), 0.02, 1.2)]
)
def test_unknown_velocities_and_readout_times_make_keyframes_less_certain(
    sigmas: tuple[float, float, float], readout_sigma_s: float, least: float
) -> None:
    scene, motion = _scene(), _Motion(sigmas, readout_sigma_s)
    count, extra, step = 6 * KEYFRAMES + 3 * POINTS, 9 * KEYFRAMES + 1, 1e-4

    def moving(values: np.ndarray) -> np.ndarray:
        return _seen_while_moving(scene, motion, values[:-1].reshape(-1, 9), values[-1]).ravel()

    by_map = np.array(
        [
            (_projected(_moved(scene, each)) - _projected(_moved(scene, -each))).ravel() / (2.0 * step)
            for each in step * np.eye(count)
        ]
    ).T
    by_motion = np.array([(moving(each) - moving(-each)) / (2.0 * step) for each in step * np.eye(extra)]).T
    # The residuals are weighted by the noise, the motion by its expected errors.
    system = np.block([[by_map / NOISE_PX, by_motion / NOISE_PX], [np.zeros((extra, count)), np.eye(extra)]])
    expected = _variances(system) / _variances(by_map / NOISE_PX)
    seen = scene.obs_px + np.random.default_rng(5).normal(0, NOISE_PX, scene.obs_px.shape)
    known, unknown = (
        np.trace(keyframe_covariances(scene, seen, cast("Any", motions)), axis1=1, axis2=2)
        for motions in (None, {"torso": motion})
    )
    # The estimated noise, by which the expected errors are weighted, is some per cent too large.
    assert unknown / known == pytest.approx(expected, rel=0.12)
    assert expected.max() > least


def test_a_part_of_the_keyframes_gives_no_smaller_covariances(
    exact: tuple[Map, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = exact[0]
    seen = scene.obs_px + np.random.default_rng(3).normal(0, NOISE_PX, scene.obs_px.shape)
    every = keyframe_covariances(scene, seen)
    monkeypatch.setattr(keyframe_covariance, "_MAX_KEYFRAMES", 4)
    part = keyframe_covariances(scene, seen)
    assert part.shape == every.shape == (KEYFRAMES, 6, 6)
    sizes = [np.trace(each, axis1=1, axis2=2).mean() for each in (every, part)]
    assert sizes[0] < sizes[1] < 20.0 * sizes[0]


def test_a_map_with_a_keyframe_that_shares_no_points_states_no_covariance() -> None:
    scene = _scene()
    # The last keyframe sees points that no other keyframe sees.
    last = scene.obs_keyframe == KEYFRAMES - 1
    points = np.concatenate([scene.points, scene.points])
    obs_point = np.where(last, scene.obs_point + POINTS, scene.obs_point)
    alone = replace(
        scene,
        points=points,
        colors=np.zeros((2 * POINTS, 3), np.uint8),
        point_error_px=np.ones(2 * POINTS),
        obs_point=obs_point,
    )
    assert keyframe_covariances(alone, alone.obs_px).shape == (0, 6, 6)


def test_a_map_of_one_keyframe_states_no_covariance() -> None:
    scene = _scene()
    own = scene.obs_keyframe == 0
    single = replace(
        scene,
        keyframe_camera=("torso",),
        keyframe_frame=scene.keyframe_frame[:1],
        map_from_cam=scene.map_from_cam[:1],
        obs_keyframe=scene.obs_keyframe[own],
        obs_point=scene.obs_point[own],
        obs_feature=scene.obs_feature[own],
        obs_px=scene.obs_px[own],
    )
    assert keyframe_covariances(single, single.obs_px).shape == (0, 6, 6)


def test_the_noise_is_that_of_the_adjusted_positions(tmp_path: Path) -> None:
    """After the adjustment, the keypoints of a rolling shutter are moved back to where they were detected."""
    pycolmap.set_random_seed(0)
    options, noise = pycolmap.SyntheticDatasetOptions(), pycolmap.SyntheticNoiseOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 120
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, model)
    (tmp_path / "colours").mkdir()
    for frame, image_id in enumerate(model.reg_image_ids()):
        image = model.image(image_id)
        image.name = ImageRef("torso", frame).name
        np.save(tmp_path / "colours" / f"{image_id}.npy", np.zeros((len(image.points2D), 3), np.uint8))
    before, adjusted = map_from_reconstruction(model, tmp_path), observed_px(model)
    for image_id in model.reg_image_ids():
        for number, point in enumerate(model.image(image_id).points2D):
            point.xy = point.xy + 10.0 * np.sin([number, 2.0 * number])
    after = map_from_reconstruction(model, tmp_path, adjusted)
    assert np.abs(after.obs_px - before.obs_px).max() > 5.0
    np.testing.assert_allclose(after.keyframe_covariance, before.keyframe_covariance, rtol=1e-6)
