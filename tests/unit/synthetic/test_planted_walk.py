"""The walk whose feet stand still: checked against published figures of level walking."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import GAIT
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.planted_walk import PlantedStyle, PlantedWalk, draw_style

TIMES = np.arange(0.0, 8.0, 1.0 / 60.0)


def walk_of(style: PlantedStyle) -> tuple[SkeletonModel, FloatArray]:
    skeleton = load_skeleton("full_body", 1.75)
    walk = PlantedWalk(skeleton, float(TIMES[-1]), style)
    return skeleton, forward_kinematics(skeleton, *walk.pose(TIMES))


@pytest.mark.parametrize(("stride_s", "strength"), [(1.2, 0.9), (1.1, 1.0), (1.0, 1.05)])
def test_level_walking_has_the_published_figures(stride_s: float, strength: float) -> None:
    skeleton, poses = walk_of(PlantedStyle(stride_s=stride_s, strength=strength))
    root = poses[:, 0, :3, 3]
    speed = float(np.linalg.norm(root[-1, :2] - root[0, :2]) / TIMES[-1])
    # Grieve and Gear 1966: steps per second at a speed, with 15 % between people.
    assert 2.0 / stride_s == pytest.approx(1.85 * (speed / 1.3) ** 0.42, rel=0.15)
    # Murray and others 1964: the trunk rises and falls by 3 to 5 cm and sways by 4 to 6 cm; knees bend by 60°
    # to 70°.
    assert 0.02 < np.ptp(root[60:, 2]) < 0.055
    across = (root - root[0])[:, 0]
    assert 0.02 < np.ptp(across[60:180] - np.linspace(across[60], across[179], 120)) < 0.08
    knee = skeleton.joints.index("LeftLeg")
    foot, hip = skeleton.joints.index("LeftFoot"), skeleton.joints.index("LeftUpLeg")
    upper = poses[:, knee, :3, 3] - poses[:, hip, :3, 3]
    lower = poses[:, foot, :3, 3] - poses[:, knee, :3, 3]
    cosine = (upper * lower).sum(axis=1) / np.linalg.norm(upper, axis=1) / np.linalg.norm(lower, axis=1)
    assert 50.0 < np.degrees(np.arccos(cosine.min())) < 70.0
    assert np.linalg.norm(root[-1, :2] - root[0, :2]) > 6.0
    assert root[-1, 1] < root[0, 1], "the person faces -y"


def test_the_lowest_point_of_the_feet_stands_still_on_the_floor() -> None:
    skeleton, poses = walk_of(PlantedStyle())
    toes = [skeleton.joints.index(side + "ToeBase") for side in ("Left", "Right")]
    balls = poses[:, toes][..., :3, 3]
    speed = np.linalg.norm(np.diff(balls, axis=0), axis=2) * 60.0
    # The ball of the flat foot is above the floor by the drop from there to the tip of the toes.
    height = balls[1:, :, 2] + skeleton.end_offsets_m[toes[0], 2]
    standing = height < 0.003
    assert 0.25 < standing.mean() < 0.75
    assert np.percentile(speed[standing], 75) < 0.15
    assert height.min() > -0.02


def test_the_person_stands_in_a_pause_and_turns() -> None:
    _, poses = walk_of(PlantedStyle(pauses=((3.0, 5.0),), turns=((5.5, 7.5, 90.0),)))
    root = poses[:, 0, :3, 3]
    still = (TIMES > 4.0) & (TIMES < 5.0)
    assert np.ptp(root[still], axis=0).max() < 1e-6
    left = poses[-1, 0, :3, 0]
    assert np.degrees(np.arctan2(left[1], left[0])) == pytest.approx(90.0, abs=6.0)


def test_a_style_is_drawn_from_its_seed() -> None:
    assert draw_style(30.0, np.random.default_rng(3)) == draw_style(30.0, np.random.default_rng(3))
    assert draw_style(30.0, np.random.default_rng(3)) != draw_style(30.0, np.random.default_rng(4))


def test_the_option_names_the_gait_or_a_file() -> None:
    assert SynthOptions(motion=GAIT).motion_file is None
    assert SynthOptions.model_validate({"motion": "gait"}).motion == GAIT
    assert SynthOptions.model_validate({"motion": Path("gait")}).motion == GAIT
    assert SynthOptions.model_validate({"motion": "walk.bvh"}).motion_file == Path("walk.bvh")
