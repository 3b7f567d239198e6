"""The merging stage on simulated poses that begin with a T-pose: detection, use and stated uncertainty."""

import json

import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.report.criteria import BODY_RULES, judge_rules
from bodycap_batch.report.grades import Grade
from bodycap_batch.synthetic import synthesise
from tests.bench import simulation

pytestmark = pytest.mark.slow  # a merge of ten seconds takes five


@pytest.fixture(scope="module")
def merged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("posed")
    context = StageContext(work_dir=folder)
    case = simulation.Case(cameras=3, seed=2, seconds=10.0)
    synthesise(case.options(), folder / "capture", context)
    inputs = simulation.load_inputs(folder / "capture")
    return folder / "capture", merge_trajectories(inputs, MergeOptions(), context)


def test_the_t_pose_is_found_at_its_time(merged):
    _, result = merged
    found = result.report.t_pose
    # The walker stands for two seconds and lowers its arms in the third; a palm is lost from 0.8 to 1 s.
    assert 0.0 <= found.from_s < 1.1
    assert found.from_s + 0.5 <= found.to_s < 2.6


def test_joints_and_mounts_are_within_their_stated_uncertainty(merged):
    folder, result = merged
    errors = simulation.score(folder, result)
    # Three times what the long capture reaches (2.6 cm): a third of its length, one seed.
    assert errors["mpjpe_m"] < 0.08
    assert abs(errors["log_scale"]) < 3.0 * errors["stated_log_scale"]
    truth = json.loads((folder / "gt" / "mounts.json").read_text())
    for mount in result.mounts:
        off = mount.joint_from_cam[:3, 3] - np.array(truth[mount.camera]["translation_m"])
        # Three axes, three sigmas.
        assert np.linalg.norm(off) < 3.0 * np.sqrt(3.0) * mount.sigma_m


def test_every_constant_has_its_sentence_and_its_sources(merged):
    _, result = merged
    report = result.report
    assert report.up.source == "walk"  # there is no map
    assert [source.name for source in report.scale.sources] == ["skeleton"]
    assert "1 sigma" in report.scale.known_to
    for camera, mount in report.mounts.items():
        assert mount.known_to.startswith(f"the uncertainty of {camera}'s mount is")
        assert "T-pose" not in mount.known_to
    for camera in ("left_palm", "right_palm"):
        assert report.mounts[camera].roll_deg == 0.0
        assert report.mounts[camera].roll_runner_up.half_squared_sigmas_more > -8.0
    assert "Left elbow not overstretched" in report.activity.rules_active


def test_the_t_pose_is_no_rare_posture(merged):
    """The walker stands with its arms stretched out for a fifth of the time, as the guides ask for."""
    _, result = merged
    doubts = judge_rules("body", BODY_RULES, {"merge": result.report.to_dict()})
    (postures,) = (item for item in doubts if item.name == "Postures")
    assert postures.grade is Grade.GOOD
