"""What lost frames see: a part of the map, the wearer, nothing, or it is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.overlay import LostView, predict_lost_views
from bodycap_batch.report import ReportInputs
from tests.bodies import CAMERAS
from tests.reports import report_inputs

LOST = slice(20, 25)


def _views(
    inputs: ReportInputs, scene: Map | None = None, *, with_body: bool = True
) -> dict[str, set[LostView]]:
    found = predict_lost_views(
        [registration.trajectory for registration in inputs.registrations],
        inputs.maps if scene is None else [scene],
        inputs.clocks,
        inputs.merge if with_body else None,
    )
    for views in found.values():
        assert views.frame.tolist() == list(range(LOST.start, LOST.stop))
        assert set(views.by_frame()) == set(range(LOST.start, LOST.stop))
    return {camera: set(views.view) for camera, views in found.items()}


def test_lost_frames_with_points_in_view_see_a_part_of_the_map() -> None:
    inputs = report_inputs(points=4000, lost=LOST)
    assert _views(inputs) == {camera: {LostView.MAP} for camera in inputs.cameras}
    assert _views(inputs, with_body=False) == {camera: {LostView.MAP} for camera in inputs.cameras}


def test_lost_frames_without_points_in_view_see_nothing() -> None:
    inputs = report_inputs(points=4000, lost=LOST)
    far_below = replace(inputs.maps[0], points=inputs.maps[0].points * 0.01 - [0.0, 0.0, 60.0])
    assert _views(inputs, far_below)["torso"] == {LostView.NOTHING}


def test_a_camera_that_looks_at_the_chest_sees_the_wearer() -> None:
    inputs = report_inputs(points=4000, lost=LOST)
    assert inputs.merge is not None
    skeleton = inputs.merge.motion.skeleton
    chest, hand = (skeleton.index_of_role(role) for role in ("Spine1", "LeftHand"))
    poses = inputs.merge.motion.world_from_joint()
    middle = (LOST.start + LOST.stop) // 2
    # 28 cm before the bone of the chest, looking back at it.
    front = poses[middle, chest] @ make_transform(
        np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), [0.0, -0.28, 0.1]
    )
    mounts = tuple(
        replace(mount, joint_from_cam=np.linalg.inv(poses[middle, hand]) @ front)
        if mount.camera == "left_palm"
        else mount
        for mount in inputs.merge.mounts
    )
    views = predict_lost_views(
        [registration.trajectory for registration in inputs.registrations],
        inputs.maps,
        inputs.clocks,
        replace(inputs.merge, mounts=mounts),
    )["left_palm"]
    assert views.view[middle - LOST.start] is LostView.WEARER
    assert views.body_share[middle - LOST.start] > 0.4


def test_without_a_body_a_long_gap_has_no_prediction() -> None:
    inputs = report_inputs(points=4000, lost=LOST)
    slow = [
        _slowed(registration.trajectory, 10) for registration in inputs.registrations
    ]  # five frames at 3 Hz: a gap of two seconds
    found = predict_lost_views(slow, inputs.maps, inputs.clocks, None)
    assert {view for views in found.values() for view in views.view} == {LostView.UNKNOWN}
    nowhere = [replace(path, gauge="another") for path in slow]
    found = predict_lost_views(nowhere, inputs.maps, inputs.clocks, None)
    assert {view for views in found.values() for view in views.view} == {LostView.UNKNOWN}


def _slowed(path: Trajectory, factor: int) -> Trajectory:
    assert path.status[LOST.start] is not FrameStatus.REGISTERED
    return replace(path, times_ns=path.times_ns[0] + factor * (path.times_ns - path.times_ns[0]))


def test_an_uncertain_body_gives_no_prediction() -> None:
    inputs = report_inputs(points=4000, lost=LOST)
    assert inputs.merge is not None
    assert inputs.merge.joint_covariance_m2 is not None
    covariance = inputs.merge.joint_covariance_m2 + 0.3**2 * np.eye(3)
    for merge in (
        replace(inputs.merge, joint_covariance_m2=covariance),
        replace(inputs.merge, joint_covariance_m2=None),
    ):
        assert _views(replace(inputs, merge=merge)) == {camera: {LostView.UNKNOWN} for camera in CAMERAS}
