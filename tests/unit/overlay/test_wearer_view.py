"""The wearer's body in the pictures: rays against capsules, and the body as the solved motion predicts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert, transform_points
from bodycap_batch.model.wearer_view import WearerView
from bodycap_batch.overlay.wearer_prediction import predict_wearer_view
from tests.bodies import merged, reaching

PINHOLE = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
BENT = Camera(
    model="OPENCV", width_px=640, height_px=480, params=np.array([420.0, 420, 320, 240, -0.2, 0.05, 0, 0])
)
FISHEYE = Camera(
    model="OPENCV_FISHEYE",
    width_px=640,
    height_px=480,
    params=np.array([300.0, 300, 320, 240, 0.03, -0.01, 0.004, -0.001]),
)


def _view(ends: list[list[float]], radii: tuple[float, float], lens: Camera = PINHOLE) -> WearerView:
    """Return one capsule in one frame."""
    return WearerView(
        camera="torso",
        lens=lens,
        world_from_cam=np.eye(4)[None],
        ends_in_cam_m=np.array([[ends]]),
        radius_m=np.array([[radii]]),
    )


def _covers(view: WearerView, x_in_cam: np.ndarray) -> list[bool]:
    px = view.lens.project(x_in_cam)
    covered: list[bool] = view.covers(px, np.zeros(len(px), np.int64)).tolist()
    return covered


@pytest.mark.parametrize("lens", [PINHOLE, BENT, FISHEYE], ids=lambda lens: lens.model)
def test_a_capsule_covers_its_silhouette_through_any_lens(lens: Camera) -> None:
    # Around an axis at depth 2 m, the silhouette is where the tangent from the lens touches: r·d/√(d² − r²).
    view = _view([[-0.5, 0.2, 2.0], [0.5, 0.2, 2.0]], (0.1, 0.1), lens)
    depth = np.hypot(2.0, 0.2)
    up = np.array([0.0, -2.0, 0.2]) / depth  # perpendicular to the axis and to the ray to the axis
    edge = 0.1 * depth / np.sqrt(depth**2 - 0.1**2)
    for x in (-0.4, 0.0, 0.4):
        axis = np.array([x, 0.2, 2.0])
        inside = np.stack([axis + sign * 0.98 * edge * up for sign in (-1.0, 1.0)])
        outside = np.stack([axis + sign * 1.02 * edge * up for sign in (-1.0, 1.0)])
        assert _covers(view, inside) == [True, True]
        assert _covers(view, outside) == [False, False]


def test_a_capsule_ends_round_and_grows_from_start_to_end() -> None:
    view = _view([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]], (0.05, 0.2))
    assert _covers(view, np.array([[-0.54, 0, 2.0], [-0.57, 0, 2.0], [0.68, 0, 2.0], [0.74, 0, 2.0]])) == [
        True,
        False,
        True,
        False,
    ]
    assert _covers(view, np.array([[-0.4, 0.1, 2.0], [0.4, 0.1, 2.0]])) == [False, True]


def test_what_is_behind_the_camera_or_unknown_covers_nothing() -> None:
    ahead = np.array([[0.0, 0.0, 1.0]])
    assert _covers(_view([[-0.5, 0.0, -0.4], [0.5, 0.0, -0.4]], (0.1, 0.1)), ahead) == [False]
    unknown = _view([[np.nan] * 3, [np.nan] * 3], (0.1, 0.1))
    assert _covers(unknown, ahead) == [False]
    assert np.isnan(unknown.share()).all()


def test_the_share_is_that_of_the_picture() -> None:
    # A wide, flat capsule: it covers the rows with |y/z| < r/√(d² − r²) of the 4:3 picture.
    view = _view([[-50.0, 0.0, 2.0], [50.0, 0.0, 2.0]], (0.4, 0.4))
    expected = 2 * 420.0 * 0.4 / np.sqrt(2.0**2 - 0.4**2) / 480.0
    assert view.share()[0] == pytest.approx(expected, abs=1 / 18)  # 18 rows of rays


def test_the_solved_body_hides_its_own_joints_and_not_the_camera() -> None:
    result, clocks = merged(reaching(30))
    path = next(path for path in result.trajectories if path.camera == "torso")
    common_ns = clocks["torso"].common_times_ns(path.times_ns)
    view = predict_wearer_view(result, "torso", PINHOLE, common_ns, path.gauge_from_cam)
    assert view.is_known.all()
    hands = [result.motion.skeleton.joints.index(f"{side}Hand") for side in ("Left", "Right")]
    joints = result.motion.world_from_joint()[:, hands][..., :3, 3]
    for frame in range(0, 30, 7):
        seen = transform_points(invert(view.world_from_cam[frame]), joints[frame])
        px = PINHOLE.project(seen)
        shown = np.isfinite(px).all(axis=1) & ((px > 0) & (px < (640, 480))).all(axis=1)
        assert view.covers(px[shown], np.full(int(shown.sum()), frame)).all()
    # A larger uncertainty hides more.
    sure = replace(result, joint_covariance_m2=np.tile(1e-6 * np.eye(3), (30, len(result.solved), 1, 1)))
    unsure = replace(result, joint_covariance_m2=np.tile(1e-3 * np.eye(3), (30, len(result.solved), 1, 1)))
    shares = [
        np.nanmean(predict_wearer_view(item, "torso", PINHOLE, common_ns, path.gauge_from_cam).share())
        for item in (sure, unsure)
    ]
    assert shares[1] >= shares[0]


def test_a_lost_frame_gets_the_place_of_the_camera_on_the_body() -> None:
    result, clocks = merged(reaching(30))
    path = next(path for path in result.trajectories if path.camera == "left_palm")
    common_ns = clocks["left_palm"].common_times_ns(path.times_ns)
    measured = predict_wearer_view(result, "left_palm", PINHOLE, common_ns, path.gauge_from_cam)
    predicted = predict_wearer_view(
        result, "left_palm", PINHOLE, common_ns, np.full_like(path.gauge_from_cam, np.nan)
    )
    apart = np.linalg.norm(predicted.world_from_cam[:, :3, 3] - measured.world_from_cam[:, :3, 3], axis=1)
    assert 0.0 < np.nanmax(apart) < 0.05  # the noise of the poses and the slack of the joints
    late = predict_wearer_view(
        result, "left_palm", PINHOLE, common_ns + 10**10, np.full_like(path.gauge_from_cam, np.nan)
    )
    assert not late.is_known.any()
    assert np.isnan(late.world_from_cam).all()
