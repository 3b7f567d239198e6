"""Points that alone determine the pose of a keyframe are removed: a false match cannot move a camera."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_robustly
from bodycap_batch.mapping.validation.dominant_points import remove_dominant_points
from bodycap_batch.model.camera import Camera

_CAMERA = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
_IMAGES = 5


def _model(near: np.ndarray, moved: float = 0.0, far_points: int = 150) -> pycolmap.Reconstruction:
    """Return a model of distant points, and of near points that three images observe.

    The last image is moved to the side and turned back, so that the distant points move least. The near
    points fit this wrong pose.
    """
    rng = np.random.default_rng(5)
    far = rng.uniform((-0.8, -0.8, 3.3), (0.8, 0.8, 3.8), (far_points, 3))
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=640, height=480, params=_CAMERA.params, camera_id=1)
    )
    for number in range(1, _IMAGES + 1):
        place = np.array([0.08 * number, 0.01 * number**2, 0.0])
        wrong = moved * (number == _IMAGES)
        turn = pycolmap.Rotation3d(np.array([0.0, -wrong / 3.55, 0.0]))
        pose = pycolmap.Rigid3d(turn, -(turn * (place + np.array([wrong, 0.0, 0.0]))))
        px = _CAMERA.project(far - place) + rng.normal(0.0, 0.1, (far_points, 2))
        extra = np.array([pose * point for point in near]).reshape(-1, 3)
        image = pycolmap.Image(
            name=f"cam/{number:06d}.png",
            keypoints=np.concatenate([px, _CAMERA.project(extra)]),
            camera_id=1,
            image_id=number,
        )
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(np.concatenate([far, near])):
        track = pycolmap.Track()
        for number in range(1, _IMAGES + 1) if index < far_points else (1, 2, _IMAGES):
            track.add_element(number, index)
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    return model


def _error_of_the_last(model: pycolmap.Reconstruction) -> float:
    """Return the error of the last camera's place, as a fraction of the way between the first and third."""
    centre = {number: model.image(number).projection_center() for number in (1, 3, _IMAGES)}
    scale = np.linalg.norm(centre[3] - centre[1]) / np.linalg.norm([0.16, 0.08])
    true = np.linalg.norm([0.32, 0.24])
    return abs(float(np.linalg.norm(centre[_IMAGES] - centre[1]) / scale) - true) / 0.18


def test_a_false_near_point_is_removed_and_the_camera_returns() -> None:
    near = np.array([[0.3, 0.1, 0.2]])
    settings = pycolmap.IncrementalPipelineOptions()
    kept = _model(near, moved=0.2)
    adjust_robustly(kept, settings, [1])
    assert _error_of_the_last(kept) > 0.15
    model = _model(near, moved=0.2)
    assert remove_dominant_points(model) == 1
    assert model.num_points3D() == 150
    adjust_robustly(model, settings, [1])
    assert _error_of_the_last(model) < 0.06


def test_near_points_that_confirm_each_other_are_kept() -> None:
    rng = np.random.default_rng(2)
    near = rng.uniform((0.2, 0.0, 0.5), (0.4, 0.2, 0.6), (20, 3))
    assert remove_dominant_points(_model(near)) == 0


@pytest.mark.parametrize("far_points", [20, 30])
def test_keyframes_with_few_points_are_not_judged(far_points: int) -> None:
    near = np.array([[0.3, 0.1, 0.2]])
    assert remove_dominant_points(_model(near, far_points=far_points)) == int(far_points > 23)
