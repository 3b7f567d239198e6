"""Foot contacts: how they are detected, and what their factors do."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.foot_contact import FootContact, contacts_in_window, find_contacts
from bodycap_batch.merging.projection.project import _standing_joints
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import posed
from tests.bodies import merged, reaching

FPS, COUNT, STAND = 30.0, 60, 25
TICKS = np.round(np.arange(COUNT) * 1e9 / FPS).astype(np.int64)
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def shin():
    """Return the skeleton, its bones, and a shin that rolls over its foot for 25 ticks, then swings."""
    skeleton = load_skeleton("full_body", 1.75)
    bones = kinematic_chain(skeleton, {"Hips", "LeftLeg"})
    index = [bone.role for bone in bones].index("LeftLeg")
    ankle_m = np.array([0.0, 0.0, -0.43])
    time = np.arange(COUNT) / FPS
    swing = np.clip((np.arange(COUNT) - STAND) / (COUNT - STAND), 0.0, 1.0)
    ankle = np.stack([0.0 * time, -1.5 * swing, 0.08 + 0.15 * np.sin(np.pi * swing)], axis=1)
    turn = so3_exp(np.outer(0.8 * np.sin(2.0 * time), [1.0, 0.0, 0.0]))
    poses = make_transform(turn, ankle - turn @ ankle_m)
    return skeleton, bones, index, poses


def _track(index, poses, seed=0):
    rng = np.random.default_rng(seed)
    noisy = poses.copy()
    noisy[:, :3, 3] += rng.normal(scale=0.005, size=(COUNT, 3))
    return CameraTrack(
        camera="left_shin",
        bone=index,
        frames=np.arange(COUNT),
        times_ns=TICKS,
        map_from_cam=noisy,
        sigma_rad=np.full(COUNT, 0.005),
        sigma_map=np.full(COUNT, 0.005),
    )


def test_a_foot_stands_while_its_ankle_is_slow_and_low(shin):
    skeleton, bones, index, poses = shin
    found = find_contacts(skeleton, bones, [_track(index, poses)], {"left_shin": np.eye(4)}, UP, TICKS)
    assert [each.name for each in found] == ["Left foot"]
    standing = found[0].standing
    # The speed is taken over five ticks, and the first and last tick of a contact are left out.
    assert standing[3 : STAND - 4].all()
    assert not standing[STAND + 2 : COUNT - 3].any()
    assert find_contacts(skeleton, bones, [], {}, UP, TICKS) == ()
    assert (
        find_contacts(skeleton, bones, [_track(index, poses)], {"left_shin": np.eye(4)}, UP, TICKS[:1]) == ()
    )
    part = contacts_in_window(found, TICKS, TICKS[10:30])
    assert np.array_equal(part[0].standing, standing[10:30])


def test_an_ankle_at_rest_costs_nothing_while_the_shin_rotates(shin):
    _, _, _, poses = shin
    contact = FootContact("Left foot", 3, 0, np.array([0.0, 0.0, -0.43]), np.ones(COUNT, dtype=bool), 0.0017)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for tick in range(COUNT):
        values.insert(bone_key(tick, 0), gtsam.Pose3(poses[tick]))
        contact.add(graph, tick)
    assert graph.size() == COUNT - 1
    assert max(graph.at(tick).error(values) for tick in range(STAND - 1)) < 1e-3
    # A swinging ankle moves by several centimetres per tick: tens of sigmas, linear under Huber's loss.
    assert graph.at(STAND + 10).error(values) > 10.0


@pytest.mark.parametrize("fps", [24.0, 60.0, 120.0, 240.0])
def test_sliding_costs_the_same_at_every_rate(shin, fps):
    skeleton, bones, index, poses = shin
    ticks = np.round(np.arange(COUNT) * 1e9 / fps).astype(np.int64)
    (found,) = find_contacts(
        skeleton,
        bones,
        [replace(_track(index, poses), times_ns=ticks)],
        {"left_shin": np.eye(4)},
        UP,
        ticks,
    )
    result, _ = merged(reaching(10))
    standing = np.zeros(result.observed.shape, dtype=bool)
    standing[:, skeleton.index_of_role("LeftLeg")] = True
    (planted,) = _standing_joints(replace(result, fps=fps, standing=standing))
    # The cost of sliding by 2 cm in a second; at 30 ticks per second, sigma is 0.05 m/s.
    costs = [fps * (0.02 / fps / sigma_m) ** 2 for sigma_m in (found.sigma_m, planted.sigma_m)]
    assert costs == pytest.approx([30.0 * (0.02 / 0.05) ** 2] * 2, rel=1e-3)


def test_contacts_reduce_sliding_in_the_solved_motion(tmp_path):
    cameras = ("hips", "left_thigh", "left_shin")
    capture = posed(SynthOptions(seconds=2.4, cameras=cameras, seed=1, poses_only=True, t_pose_s=2.0))
    slides = []
    for held in (True, False):
        options, context = MergeOptions(foot_contact=held), StageContext(work_dir=tmp_path)
        result = merge_trajectories(capture.inputs, options, context)
        reported = result.report.foot_contact
        assert list(reported) == (["Left foot"] if held else [])
        roles = result.skeleton.roles
        still = result.graph_world_from_joint[10:50, roles.index("LeftFoot"), :3, 3]
        slides.append(float(np.linalg.norm(np.diff(still, axis=0), axis=1).mean()) * FPS)
    # In the T-pose, during two of 2.4 seconds, the foot stands. The poses have 5 mm of noise.
    assert slides[0] < 0.7 * slides[1]
