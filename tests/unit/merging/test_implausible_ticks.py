"""A gross error of a single pose does not change the calibration of the body: its instant is left out."""

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import MIN_SAMPLES, take_samples
from bodycap_batch.merging.body_calibration.scale import estimate_scale
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.nominal_mounts import nominal_mount
from tests.bodies import reaching

ROLES = {"torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand"}
TICKS, SAMPLES = 120, 40
GROSS_M = np.array([0.5, 0.5, 0.4])


def _graph(shift_m: FloatArray, t_pose_ns: tuple[int, int] | None = None) -> CalibrationGraph:
    """Return the graph of a body that reaches; the right palm's centres are shifted by (T,3) metres."""
    motion = reaching(TICKS)
    skeleton, poses = motion.skeleton, motion.world_from_joint()
    bones = kinematic_chain(skeleton, ROLES.values())
    index = {bone.role: number for number, bone in enumerate(bones)}
    mounts = {camera: nominal_mount(camera, role, skeleton) for camera, role in ROLES.items()}
    tracks = []
    for camera, role in ROLES.items():
        path = poses[:, skeleton.index_of_role(role)] @ mounts[camera].joint_from_cam
        if camera == "right_palm":
            path[:, :3, 3] += shift_m
        tracks.append(
            CameraTrack(
                camera=camera,
                bone=index[role],
                frames=np.arange(TICKS),
                times_ns=np.round(np.arange(TICKS) * (1e9 / 30.0)).astype(np.int64),
                map_from_cam=path,
                sigma_rad=np.full(TICKS, 0.005),
                sigma_map=np.full(TICKS, 0.004),
            )
        )
    samples = take_samples(tracks, 1.0, SAMPLES, t_pose_ns=t_pose_ns)
    return CalibrationGraph(skeleton, bones, samples, mounts, 1.0, lambda: None)


def _shift(*ticks: int) -> FloatArray:
    shift_m = np.zeros((TICKS, 3))
    shift_m[list(ticks)] = GROSS_M
    return shift_m


def _scale(graph: CalibrationGraph) -> float:
    return estimate_scale(graph, 1.0).scale


def test_one_gross_error_changes_the_scale_unless_its_tick_is_left_out():
    right, wrong = _graph(_shift()), _graph(_shift(TICKS - 1))
    assert right.solve_without_implausible_ticks(1.0) == 0
    assert wrong.solve_without_implausible_ticks(1.0) == 1
    assert len(wrong.samples.times_ns) == len(right.samples.times_ns) - 1
    expected = _scale(right)
    assert _scale(wrong) == pytest.approx(expected, rel=0.01)
    assert abs(np.log(_scale(_graph(_shift(TICKS - 1))) / expected)) > 0.04


def test_several_gross_errors_are_left_out():
    times_ns = _graph(_shift()).samples.times_ns
    ticks = np.round(times_ns[[0, 11, 25]] * 30e-9).astype(int).tolist()
    graph = _graph(_shift(*ticks))
    assert graph.solve_without_implausible_ticks(1.0) == 3
    assert not set(times_ns[[0, 11, 25]].tolist()) & set(graph.samples.times_ns.tolist())


def test_a_map_of_a_palm_that_is_wrong_all_the_time_stays_visible():
    graph = _graph(np.tile(GROSS_M, (TICKS, 1)))
    assert graph.solve_without_implausible_ticks(1.0) == 0


def test_the_ticks_of_a_t_pose_are_kept():
    last_ns = round((TICKS - 1) * 1e9 / 30.0)
    graph = _graph(_shift(TICKS - 1), t_pose_ns=(last_ns - 1_000_000, last_ns))
    assert graph.solve_without_implausible_ticks(1.0) == 0


def test_a_camera_keeps_its_few_ticks():
    wrong = np.arange(TICKS - 3, TICKS)
    graph = _graph(_shift(*wrong.tolist()))
    samples = graph.samples
    few = samples.valid.copy()
    few[samples.cameras.index("right_palm"), : -MIN_SAMPLES + 1] = False
    graph.set_samples(replace(samples, valid=few))
    assert graph.solve_without_implausible_ticks(1.0) == 0
