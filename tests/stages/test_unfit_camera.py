"""A camera that fits no person together with the others is left out, and the others give the body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import ImplausibleBody, error_from_dict
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.model.scene import Trajectory
from tests.stages.walker import ROLES, make_inputs, make_walk, record


def _walk_with(wrong: dict[str, float]) -> tuple[list[Trajectory], object]:
    """Return paths of which some are magnified about their first position, and the walk."""
    walk = make_walk(np.random.default_rng(1), off_deg=6.0, off_m=0.015)
    rng = np.random.default_rng(7)
    paths = [record(walk, name, rng) for name in ROLES]
    return [_magnified(path, wrong.get(path.camera, 1.0)) for path in paths], walk


def _magnified(path: Trajectory, factor: float) -> Trajectory:
    poses = np.array(path.gauge_from_cam)
    poses[:, :3, 3] = poses[0, :3, 3] + factor * (poses[:, :3, 3] - poses[0, :3, 3])
    return replace(path, gauge_from_cam=poses)


def test_the_camera_that_does_not_fit_is_left_out(tmp_path: Path) -> None:
    wrong = "right_palm"
    paths, walk = _walk_with({wrong: 30.0})
    result = merge_trajectories(make_inputs(walk, paths), MergeOptions(), StageContext(work_dir=tmp_path))
    assert set(result.unused_cameras) == {wrong}
    assert {path.camera for path in result.trajectories} == set(ROLES) - {wrong}
    hand = result.skeleton.roles.index(ROLES[wrong])
    assert not result.observed[:, hand].any()
    # The skeleton was measured, so the scale of the remaining cameras is right to a few percent.
    assert result.report.scale.metres_per_map_unit == pytest.approx(1.0, abs=0.1)


def _on_a_table(path: Trajectory) -> Trajectory:
    poses = np.array(path.gauge_from_cam)
    noise = np.random.default_rng(3).normal(scale=0.003, size=(len(poses), 3))
    poses[:] = poses[0]
    poses[:, :3, 3] += np.array([1.0, 0.5, -0.2]) + noise
    return replace(path, gauge_from_cam=poses)


def _second_half_of(path: Trajectory, other: Trajectory) -> Trajectory:
    poses, half = np.array(path.gauge_from_cam), len(path.times_ns) // 2
    poses[half:] = other.gauge_from_cam[half:]
    return replace(path, gauge_from_cam=poses)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["on a table", "of another time", "half of another time"])
def test_a_camera_of_another_place_or_time_does_not_end_the_job(fault: str, tmp_path: Path) -> None:
    walk = make_walk(np.random.default_rng(1), off_deg=6.0, off_m=0.015)
    rng = np.random.default_rng(7)
    paths = {name: record(walk, name, rng, seconds=5.0) for name in ROLES}
    late = record(walk, "left_palm", rng, seconds=5.0, shift_s=4.0)
    paths["left_palm"] = {
        "on a table": _on_a_table(paths["left_palm"]),
        "of another time": late,
        "half of another time": _second_half_of(paths["left_palm"], late),
    }[fault]
    inputs = make_inputs(walk, list(paths.values()))
    result = merge_trajectories(inputs, MergeOptions(), StageContext(work_dir=tmp_path))
    assert set(result.unused_cameras) == {"left_palm"}
    scale = result.report.scale
    assert abs(scale.metres_per_map_unit - 1.0) < 3.0 * scale.relative_sigma


@pytest.mark.slow
def test_two_cameras_that_do_not_fit_are_refused_as_before(tmp_path: Path) -> None:
    paths, walk = _walk_with({"left_palm": 30.0, "right_palm": 0.01})
    with pytest.raises(ImplausibleBody, match="not possible for a person") as caught:
        merge_trajectories(make_inputs(walk, paths), MergeOptions(), StageContext(work_dir=tmp_path))
    # The error keeps its exit code on the way from the child process.
    assert error_from_dict(caught.value.to_dict()).exit_code == 4
