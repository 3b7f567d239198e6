"""Wrong facts about a camera: a wrong clock, speed or place on the body.

Each result must be right within its stated sigmas, or the report must name the camera, or the verdict must
doubt the body.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.clocks import (
    ClockEstimate,
    ClockEstimates,
    SoundEvidence,
    add_motion,
    clocks_from_paths,
    decide_clocks,
    stated_offsets,
)
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.report.criteria import BODY_RULES, judge_rules
from bodycap_batch.report.grades import Grade
from tests.stages.walker import FPS, ROLES, Walk, make_inputs, make_walk, record

pytestmark = pytest.mark.slow


SECONDS = 5.0
SIGMAS = 3.0
"""Largest error in stated sigmas: 99.7 % of a normal distribution."""


@pytest.fixture(scope="module")
def walk() -> Walk:
    return make_walk(np.random.default_rng(1), off_deg=6.0, off_m=0.015)


def _recorded(walk: Walk, **shift_s: float) -> list[Trajectory]:
    """Return the trajectories of a walk with turns, in metres, with clocks that are wrong by some seconds."""
    rng = np.random.default_rng(7)
    return [record(walk, name, rng, seconds=SECONDS, shift_s=shift_s.get(name, 0.0)) for name in ROLES]


def _merged(walk: Walk, trajectories: list[Trajectory], folder) -> MergeResult | None:
    """Return the result; None if merging refuses the capture."""
    try:
        return merge_trajectories(
            make_inputs(walk, trajectories), MergeOptions(), StageContext(work_dir=folder)
        )
    except EstimationError:
        return None


def _contradicted_clocks(trajectories: list[Trajectory]) -> set[str]:
    """Return the cameras whose stated clock, with the offset 0, the motion contradicts."""
    cameras = tuple(
        CameraConfig(name=name, video=(Path(f"{name}.mp4"),), segment=role, offset_s=0.0)
        for name, role in ROLES.items()
    )
    spec = CaptureConfig(cameras=cameras)
    unknown = tuple(ClockEstimate(camera=name) for name in ROLES)
    estimates = ClockEstimates(reference="torso", cameras=unknown)
    motion = clocks_from_paths(trajectories, ROLES, "torso")
    stated_s = stated_offsets(spec, "torso")
    clocks = decide_clocks(spec, add_motion(estimates, motion, SoundEvidence(), stated_s))
    return {name for name, clock in clocks.cameras.items() if clock.is_contradicted}


CONTRADICTIONS = (
    "Postures",
    "Sources of the scale",
    "Cameras in their usual places",
)
"""Criteria that a wrong fact violates; scale and mounts can be uncertain without any wrong fact."""


def _doubts(result: MergeResult) -> list[str]:
    """Return the findings about contradictions in the body that lower the grade of the motion."""
    rules = [rule for rule in BODY_RULES if rule.name in CONTRADICTIONS]
    found = judge_rules("body", rules, {"merge": result.report.to_dict()})
    return [item.finding for item in found if item.grade is not Grade.GOOD]


def _require_honest_scale(result: MergeResult | None, cameras: tuple[str, ...], reported: set[str]) -> None:
    """Require that the metric scale is right, or that the report names a wrong camera or doubts the body."""
    if result is None or {*reported, *result.report.unused_cameras} & set(cameras) or _doubts(result):
        return
    # The map is in metres.
    scale, sigma = result.world_from_map["map-0"].scale, result.report.scale.relative_sigma
    assert abs(np.log(scale)) < SIGMAS * sigma, (
        f"scale {100 * (scale - 1):+.0f} %, {100 * sigma:.0f} % stated"
    )


def _changed(trajectories: list[Trajectory], camera: str, change) -> list[Trajectory]:
    return [change(each) if each.camera == camera else each for each in trajectories]


def _without_second(path: Trajectory) -> Trajectory:
    """Cut one second out of the middle of a video; the later frames follow without a gap in time."""
    number = np.arange(len(path.status))
    kept = (number < 2 * FPS) | (number >= 3 * FPS)
    count = int(kept.sum())
    return replace(
        path,
        frame_numbers=path.frame_numbers[:count],
        times_ns=path.times_ns[:count],
        gauge_from_cam=path.gauge_from_cam[kept],
        covariance=path.covariance[kept],
        status=path.status[:count],
        inliers=path.inliers[kept],
        error_px=path.error_px[kept],
    )


def _at_half_speed(path: Trajectory) -> Trajectory:
    return replace(path, times_ns=2 * path.times_ns)


def test_right_facts_give_the_right_scale(walk: Walk, tmp_path) -> None:
    paths = _recorded(walk)
    result = _merged(walk, paths, tmp_path)
    assert result is not None
    assert not _contradicted_clocks(paths)
    assert not _doubts(result)
    _require_honest_scale(result, (), set())


@pytest.mark.parametrize(
    "shift_s",
    [
        {"left_palm": 0.3, "right_palm": -0.3},
        {"left_palm": 0.4, "right_palm": -0.4},
        {"left_palm": 0.5},
    ],
    ids=["0.3 s", "0.4 s", "0.5 s"],
)
def test_wrong_clocks(shift_s: dict[str, float], walk: Walk, tmp_path) -> None:
    paths = _recorded(walk, **shift_s)
    _require_honest_scale(_merged(walk, paths, tmp_path), tuple(shift_s), _contradicted_clocks(paths))


def test_a_palm_at_half_speed(walk: Walk, tmp_path) -> None:
    paths = _changed(_recorded(walk), "left_palm", _at_half_speed)
    _require_honest_scale(_merged(walk, paths, tmp_path), ("left_palm",), _contradicted_clocks(paths))


def test_exchanged_palms_are_named(walk: Walk, tmp_path) -> None:
    other = {"left_palm": "right_palm", "right_palm": "left_palm"}
    paths = [replace(path, camera=other.get(path.camera, path.camera)) for path in _recorded(walk)]
    result = _merged(walk, paths, tmp_path)
    assert result is not None
    assert result.report.exchanged_sides is not None
    assert set(result.report.exchanged_sides.cameras) == set(other)


@pytest.mark.parametrize("camera", ["torso", "left_palm"])
def test_a_video_with_a_second_cut_out(camera: str, walk: Walk, tmp_path) -> None:
    paths = _changed(_recorded(walk), camera, _without_second)
    # If the trunk's video is cut, the limbs' clocks disagree with it.
    _require_honest_scale(_merged(walk, paths, tmp_path), tuple(ROLES), _contradicted_clocks(paths))


def test_an_upper_arm_given_as_a_palm(walk: Walk, tmp_path) -> None:
    on_arm = nominal_mount("left_upper_arm", "LeftArm", walk.skeleton)
    worn = replace(walk, mounts={**walk.mounts, "left_palm": replace(on_arm, camera="left_palm")})
    result = _merged(walk, _recorded(worn), tmp_path)
    if result is None or "left_palm" in result.report.unused_cameras or _doubts(result):
        return
    hand, trunk = (result.skeleton.roles.index(role) for role in ("LeftHand", "Spine1"))
    truth = walk.joints(result.times_ns() * 1e-9)[..., :3, :3]
    turns = [
        np.swapaxes(poses[:, trunk], -1, -2) @ poses[:, hand]
        for poses in (result.graph_world_from_joint[..., :3, :3], truth)
    ]
    error_deg = np.degrees(np.median(rotation_angle_rad(np.swapaxes(turns[0], -1, -2) @ turns[1])))
    (mount,) = (each for each in result.mounts if each.camera == "left_palm")
    # Three axes, each with the stated sigma of the mount.
    limit_deg = SIGMAS * np.sqrt(3.0) * np.degrees(mount.sigma_rad)
    assert error_deg < limit_deg, f"hand {error_deg:.0f}° off, {np.degrees(mount.sigma_rad):.0f}° stated"
