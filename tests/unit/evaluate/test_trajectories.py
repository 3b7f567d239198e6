"""Trajectory errors: equal to those of evo, invariant to the gauge, sensitive to real errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate import (
    relative_camera_error,
    score_trajectories,
)
from bodycap_batch.formats.tum import TimedPoses, read_tum, write_tum
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from tests.evaluation import evaluate_trajectories

RATE_NS = 33_333_333


def walk(seed: int, frames: int = 300, *, noise_m: float = 0.0, phase: float = 0.0) -> TimedPoses:
    """Return a camera that moves along a curved path and looks around."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / 30.0
    position = np.stack([np.sin(time + phase), 1.3 * np.cos(0.7 * time), 0.05 * np.sin(9 * time)], axis=1)
    turn = Rotation.from_euler(
        "ZXY", np.stack([40 * time, 9 * np.sin(5 * time), 0 * time], axis=1), degrees=True
    )
    turn = turn * Rotation.from_rotvec(rng.normal(scale=noise_m, size=(frames, 3)))
    position = position + rng.normal(scale=noise_m, size=(frames, 3)) if noise_m else position
    return TimedPoses(
        times_ns=1_000_000_000_000 + np.arange(frames) * RATE_NS,
        world_from_cam=make_transform(turn.as_matrix(), position),
    )


def moved(poses: TimedPoses, by: Similarity) -> TimedPoses:
    return TimedPoses(times_ns=poses.times_ns, world_from_cam=by.apply_to_poses(poses.world_from_cam))


def evo_errors(
    estimate: Path, truth: Path, *, scale: bool, max_diff_s: float, delta: int = 0
) -> dict[str, float]:
    from evo.core import metrics, sync
    from evo.tools import file_interface

    true = file_interface.read_tum_trajectory_file(str(truth))
    estimate_path = file_interface.read_tum_trajectory_file(str(estimate))
    true, estimate_path = sync.associate_trajectories(true, estimate_path, max_diff=max_diff_s)
    estimate_path.align(true, correct_scale=scale)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((true, estimate_path))
    out = {"ate": ate.get_statistic(metrics.StatisticsType.rmse), "count": float(len(ate.error))}
    if delta:
        rpe = metrics.RPE(metrics.PoseRelation.translation_part, delta, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((true, estimate_path))
        out["rpe"] = rpe.get_statistic(metrics.StatisticsType.rmse)
        turn = metrics.RPE(
            metrics.PoseRelation.rotation_angle_deg, delta, metrics.Unit.frames, all_pairs=True
        )
        turn.process_data((true, estimate_path))
        out["rpe_deg"] = turn.get_statistic(metrics.StatisticsType.rmse)
    return out


@pytest.mark.parametrize("align", ["sim3", "se3"])
def test_same_as_evo(tmp_path: Path, align: str) -> None:
    truth, noisy = walk(0), walk(1, noise_m=0.02)
    shift = Similarity(
        0.31 if align == "sim3" else 1.0, so3_exp([0.3, 2.0, -1.0]), np.array([5.0, -2.0, 1.0])
    )
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "mine.tum", moved(noisy, shift))
    ours = evaluate_trajectories({"a": tmp_path / "mine.tum"}, {"a": tmp_path / "truth.tum"}, align).total  # type: ignore[arg-type]
    theirs = evo_errors(
        tmp_path / "mine.tum", tmp_path / "truth.tum", scale=align == "sim3", max_diff_s=0.01, delta=30
    )
    assert ours.ate_m is not None
    assert ours.rpe_m is not None
    assert ours.rpe_deg is not None
    assert ours.scored == theirs["count"] == 300
    assert ours.ate_m.rmse == pytest.approx(theirs["ate"], abs=1e-6)
    assert ours.rpe_m.rmse == pytest.approx(theirs["rpe"], abs=1e-6)
    assert ours.rpe_deg.rmse == pytest.approx(theirs["rpe_deg"], abs=1e-6)
    # 2 cm per coordinate with seven fitted parameters of 900 give 3.5 cm
    assert 0.030 < ours.ate_m.rmse < 0.038


@pytest.mark.data
def test_same_as_evo_on_real_data(data_root: Path, tmp_path: Path) -> None:
    """Motion capture at 100 Hz with a gap, and an estimate with noise at every third time."""
    truth_path = data_root / "tum_fr1_xyz" / "groundtruth.txt"
    truth = read_tum(truth_path)
    noisy = truth.world_from_cam[::3].copy()
    noise = np.random.default_rng(5).normal(scale=0.004, size=(len(noisy), 3))
    noisy[:, :3, 3] = 0.4 * noisy[:, :3, 3] + noise
    write_tum(tmp_path / "mine.tum", TimedPoses(times_ns=truth.times_ns[::3], world_from_cam=noisy))
    ours = evaluate_trajectories({"a": tmp_path / "mine.tum"}, {"a": truth_path}).total
    theirs = evo_errors(tmp_path / "mine.tum", truth_path, scale=True, max_diff_s=0.001)
    assert ours.scored == theirs["count"]
    assert ours.ate_m is not None
    assert ours.ate_m.rmse == pytest.approx(theirs["ate"], abs=1e-6)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.floats(0.01, 100.0),
    vector=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
)
def test_moving_turning_and_scaling_the_estimate_changes_nothing(
    seed: int, scale: float, vector: list[float]
) -> None:
    truths = {"a": walk(seed, 60), "b": walk(seed, 60, phase=0.4)}
    estimates = {"a": walk(seed, 60, noise_m=0.01), "b": walk(seed + 1, 60, noise_m=0.01, phase=0.4)}
    change = Similarity(scale, so3_exp(vector[:3]), np.array(vector[3:]))
    before = score_trajectories(estimates, truths)
    after = score_trajectories({name: moved(poses, change) for name, poses in estimates.items()}, truths)
    assert before.total.ate_m is not None
    assert after.total.ate_m is not None
    assert after.total.ate_m.rmse == pytest.approx(before.total.ate_m.rmse, rel=1e-9)
    assert after.scale == pytest.approx(before.scale / scale, rel=1e-9)
    assert after.total.rotation_deg is not None
    assert before.total.rotation_deg is not None
    assert after.total.rotation_deg.rmse == pytest.approx(before.total.rotation_deg.rmse, rel=1e-6)


def test_one_similarity_for_all_cameras() -> None:
    """Each camera alone has no error, but they are displaced by 10 cm; the common alignment must show it."""
    truths = {"a": walk(0), "b": walk(0, phase=0.4)}
    shifted = moved(truths["b"], Similarity(1.0, np.eye(3), np.array([0.1, 0.0, 0.0])))
    together = score_trajectories({"a": truths["a"], "b": shifted}, truths).total.ate_m
    alone = score_trajectories({"b": shifted}, truths).total.ate_m
    assert together is not None
    assert alone is not None
    assert alone.rmse < 1e-9
    # the best alignment leaves 5 cm for each camera; rotation and scale reduce it little
    assert 0.035 < together.rmse < 0.0501


def test_alignment_modes_differ_in_scale_and_position() -> None:
    truth = walk(0)
    scaled = moved(truth, Similarity(1.1, np.eye(3), np.zeros(3)))
    shifted = moved(truth, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, 0.2])))

    def rmse(poses: TimedPoses, align: str) -> float:
        score = score_trajectories({"a": poses}, {"a": truth}, align).total.ate_m  # type: ignore[arg-type]
        assert score is not None
        return score.rmse

    assert rmse(scaled, "sim3") < 1e-9
    assert rmse(scaled, "se3") > 0.05
    assert rmse(shifted, "se3") < 1e-9
    assert rmse(shifted, "none") == pytest.approx(0.2)


def test_truth_is_interpolated_and_long_gaps_are_refused() -> None:
    """Half way between two true poses the truth is half way; in a gap of 0.5 s there is no truth."""
    times = np.array([0, 100, 200, 700, 800]) * 1_000_000
    position = np.stack([times / 1e9, np.zeros(5), np.zeros(5)], axis=1)
    turn = so3_exp(np.stack([np.zeros(5), np.zeros(5), times / 1e9], axis=1))
    truth = TimedPoses(times_ns=times, world_from_cam=make_transform(turn, position))
    at = np.array([-50, 50, 150, 450, 700, 750, 900]) * 1_000_000
    exact = make_transform(
        so3_exp(np.stack([np.zeros(7), np.zeros(7), at / 1e9], axis=1)),
        np.stack([at / 1e9, np.zeros(7), np.zeros(7)], axis=1),
    )
    score = score_trajectories(
        {"a": TimedPoses(times_ns=at, world_from_cam=exact)}, {"a": truth}, "none", {"a": 14}
    )
    assert (score.total.registered, score.total.scored, score.total.coverage) == (7, 4, 0.5)
    assert score.total.ate_m is not None
    assert score.total.rotation_deg is not None
    assert score.total.ate_m.max < 1e-12
    assert score.total.rotation_deg.max < 1e-6


def test_a_time_slightly_outside_the_truth_has_a_true_pose() -> None:
    truth = walk(0, 10)
    late = TimedPoses(times_ns=truth.times_ns + 50_000, world_from_cam=truth.world_from_cam)
    assert score_trajectories({"a": late}, {"a": truth}).total.scored == 10


def test_a_wrong_clock_shows() -> None:
    truth = walk(0)
    late = TimedPoses(times_ns=truth.times_ns + 120_000_000, world_from_cam=truth.world_from_cam)
    error = score_trajectories({"a": late}, {"a": truth}, "none").total.ate_m
    assert error is not None
    # 0.12 s at 0.4 to 1.4 m/s
    assert 0.04 < error.mean < 0.17


def test_a_camera_without_poses_counts_against_coverage() -> None:
    nothing = TimedPoses(times_ns=np.zeros(0, dtype=np.int64), world_from_cam=np.zeros((0, 4, 4)))
    truths = {"a": walk(0), "b": walk(0)}
    score = score_trajectories({"a": walk(0), "b": nothing}, truths, frames={"a": 300, "b": 300})
    assert score.cameras["b"].ate_m is None
    assert (score.cameras["b"].coverage, score.total.coverage) == (0.0, 0.5)
    with pytest.raises(JobError, match="0 frames have estimated and true poses of both"):
        relative_camera_error({"a": walk(0), "b": nothing}, truths, "a", "b")
    with pytest.raises(JobError, match="true path of camera b has no poses"):
        score_trajectories({"b": walk(0)}, {"b": nothing})


def test_missing_truth_and_other_clocks_are_named() -> None:
    with pytest.raises(JobError, match="no true path for camera b"):
        score_trajectories({"a": walk(0), "b": walk(0)}, {"a": walk(0)})
    other = TimedPoses(times_ns=np.arange(5), world_from_cam=walk(0, 5).world_from_cam)
    with pytest.raises(JobError, match="only 0 poses have a true pose"):
        score_trajectories({"a": walk(0)}, {"a": other})


def test_relative_error_of_two_cameras() -> None:
    """The palm is 3 cm wrong in the torso's frame; a rigid transform adds no error, a scale does."""
    truths = {"torso": walk(0), "palm": walk(0, phase=0.4)}
    off: FloatArray = truths["torso"].world_from_cam[:, :3, :3] @ np.array([0.0, 0.03, 0.0])
    palm = truths["palm"].world_from_cam.copy()
    palm[:, :3, 3] += off
    change = Similarity(1.0, so3_exp([0.1, 0.2, 1.0]), np.array([4.0, 0.0, 1.0]))
    estimates = {
        "torso": moved(truths["torso"], change),
        "palm": moved(TimedPoses(times_ns=truths["palm"].times_ns, world_from_cam=palm), change),
    }
    error = relative_camera_error(estimates, truths, "palm", "torso")
    assert error.frames == 300
    assert error.in_reference_m.mean == pytest.approx(0.03, abs=1e-9)
    # both paths are aligned together, not their difference, which changes the error by up to a tenth
    assert 0.027 < error.vector_m.mean < 0.033
    bigger = {n: moved(p, Similarity(1.2, np.eye(3), np.zeros(3))) for n, p in truths.items()}
    span = np.linalg.norm(
        truths["palm"].world_from_cam[:, :3, 3] - truths["torso"].world_from_cam[:, :3, 3], axis=1
    )
    in_reference = relative_camera_error(bigger, truths, "palm", "torso").in_reference_m
    assert in_reference.mean == pytest.approx(0.2 * span.mean())


def test_rotations_without_positions_have_an_alignment_of_their_own() -> None:
    truth = walk(1)
    turn = so3_exp([0.3, -0.2, 0.9])
    alone = truth.world_from_cam.copy()
    alone[:, :3, :3] = turn @ alone[:, :3, :3]
    alone[:, :3, 3] = 0.0
    alone[7, :3, :3] = alone[7, :3, :3] @ so3_exp([np.radians(20.0), 0.0, 0.0])
    estimates = {
        "head": TimedPoses(times_ns=truth.times_ns, world_from_cam=alone),
        "torso": walk(2, phase=1.0),
    }
    truths = {"head": truth, "torso": walk(2, phase=1.0)}
    report = score_trajectories(estimates, truths, frames={"head": 300, "torso": 300})
    head, torso = report.cameras["head"], report.cameras["torso"]
    assert (head.registered, head.coverage, head.scored, head.ate_m, head.rpe_m) == (0, 0.0, 300, None, None)
    assert head.rotation_deg is not None
    assert head.rotation_deg.max == pytest.approx(20.0, abs=0.2)
    assert head.rotation_deg.median < 0.1
    assert torso.ate_m is not None
    assert torso.ate_m.max < 1e-9  # the other camera does not disturb the common alignment
    single = score_trajectories({"head": estimates["head"]}, {"head": truth})
    assert single.total.rotation_deg == head.rotation_deg
