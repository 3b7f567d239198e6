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


@pytest.mark.parametrize("wrong", ["left_palm", "right_palm"])
def test_the_camera_that_does_not_fit_is_left_out(wrong: str, tmp_path: Path) -> None:
    paths, walk = _walk_with({wrong: 30.0})
    result = merge_trajectories(make_inputs(walk, paths), MergeOptions(), StageContext(work_dir=tmp_path))
    assert set(result.unused_cameras) == {wrong}
    assert {path.camera for path in result.trajectories} == set(ROLES) - {wrong}
    hand = result.skeleton.roles.index(ROLES[wrong])
    assert not result.observed[:, hand].any()
    # The skeleton was measured, so the scale of the remaining cameras is right to a few percent.
    assert result.report.scale.metres_per_map_unit == pytest.approx(1.0, abs=0.1)


def test_two_cameras_that_do_not_fit_are_refused_as_before(tmp_path: Path) -> None:
    paths, walk = _walk_with({"left_palm": 30.0, "right_palm": 0.01})
    with pytest.raises(ImplausibleBody, match="not possible for a person") as caught:
        merge_trajectories(make_inputs(walk, paths), MergeOptions(), StageContext(work_dir=tmp_path))
    # The error keeps its exit code on the way from the child process.
    assert error_from_dict(caught.value.to_dict()).exit_code == 4
