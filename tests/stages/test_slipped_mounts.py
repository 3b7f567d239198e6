"""A take in which the straps of two cameras slip: found, solved as other mounts, and stated in the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.model.geometry import make_transform, rotation_angle_rad, so3_exp
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import GAUGE, posed
from tests.bench.simulation import PALMS
from tests.bench.slips import Take, joint_errors, slip_ns

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
CAMERA, OTHER = "left_palm", "right_palm"


@pytest.fixture(scope="module")
def take() -> Take:
    capture = posed(
        SynthOptions(
            poses_only=True, seconds=3.0, cameras=PALMS, seed=4, walk="gait", pose_sigma_m=0.001,
            pose_sigma_deg=0.03,
        )
    )  # fmt: skip
    step = make_transform(so3_exp(np.radians(15.0) * AXIS), 0.01 * AXIS)
    return Take(name="take", capture=capture, camera=CAMERA, frame=45, step=step, kind="turn", noise_m=0.001)


@pytest.fixture(scope="module")
def slipped(take: Take) -> MergeResult:
    other = replace(take, camera=OTHER, frame=55)
    (path,) = (each for each in other.slipped(1).trajectories if each.camera == OTHER)
    inputs = take.slipped(1)
    paths = tuple(path if each.camera == OTHER else each for each in inputs.trajectories)
    return merge_trajectories(
        replace(inputs, trajectories=paths), MergeOptions(), StageContext(work_dir=Path())
    )


@pytest.fixture(scope="module")
def untouched(take: Take) -> MergeResult:
    return merge_trajectories(take.capture.inputs, MergeOptions(), StageContext(work_dir=Path()))


def test_an_untouched_take_has_no_slip(untouched: MergeResult) -> None:
    assert [mount.slip for mount in untouched.mounts] == [None] * 3
    assert "slipped_mounts" not in untouched.report.to_dict()


def test_the_report_states_the_slip(take: Take, slipped: MergeResult) -> None:
    assert slipped.report.slipped_mounts is not None
    assert set(slipped.report.slipped_mounts.cameras) == {CAMERA, OTHER}
    found = slipped.report.slipped_mounts.cameras[CAMERA]
    assert found.at_s == pytest.approx(1e-9 * (slip_ns(take) - slipped.start_ns), abs=1.0 / 30.0)
    # 4 sigma per axis; the scale of a take of three seconds is known to some per cent of 1 cm.
    assert found.turned_deg == pytest.approx(15.0, abs=4.0 * found.sigma_deg)
    assert found.moved_m == pytest.approx(0.01, abs=4.0 * found.sigma_m)
    assert found.sigma_deg < 1.5
    says = slipped.report.slipped_mounts.says
    assert f"{CAMERA} slipped {found.at_s:.1f} s after the start" in says
    (mount,) = (mount for mount in slipped.mounts if mount.camera == CAMERA)
    turn = np.array(found.joint_from_cam)[:3, :3].T @ mount.joint_from_cam[:3, :3]
    assert np.degrees(rotation_angle_rad(turn)) == pytest.approx(found.turned_deg, abs=1e-3)


def test_the_joints_after_a_slip_are_as_exact_as_without_it(
    take: Take, slipped: MergeResult, untouched: MergeResult
) -> None:
    found, usual = joint_errors(take, slipped), joint_errors(take, untouched)
    assert found == pytest.approx(usual, rel=0.2)


def test_the_path_of_the_camera_is_its_own_after_the_slip(take: Take, slipped: MergeResult) -> None:
    path = next(each for each in slipped.trajectories if each.camera == CAMERA)
    given = next(each for each in take.slipped(1).trajectories if each.camera == CAMERA)
    measured = slipped.world_from_map[GAUGE].apply_to_poses(given.gauge_from_cam)
    seen = path.localised & given.localised
    turn = np.swapaxes(measured[seen, :3, :3], 1, 2) @ path.gauge_from_cam[seen, :3, :3]
    assert rotation_angle_rad(turn).max() < 1e-6
    # The centres move by the noise (1 mm) and by the gaps at the joints, but not by a part of the slip.
    off = np.linalg.norm(measured[seen, :3, 3] - path.gauge_from_cam[seen, :3, 3], axis=1)
    after = np.flatnonzero(seen) >= take.frame
    assert np.median(off[after]) < 0.004
    assert slipped.projection_gap["cameras"][CAMERA]["p95_deg"] < 5.0


def test_a_slip_is_stored_with_its_mount(slipped: MergeResult, tmp_path: Path) -> None:
    write_dataclass(slipped, tmp_path, "merge")
    again = read_dataclass(MergeResult, tmp_path, "merge")
    for one, other in zip(again.mounts, slipped.mounts, strict=True):
        assert (one.slip is None) == (other.slip is None)
        if one.slip is not None and other.slip is not None:
            assert one.slip.time_ns == other.slip.time_ns
            np.testing.assert_array_equal(one.slip.before_from_after, other.slip.before_from_after)
    values = slipped.report.to_dict()
    assert MergeReport.from_dict(json.loads(json.dumps(values))).to_dict() == values
