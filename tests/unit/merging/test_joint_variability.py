"""How lively joints are: what residuals show, what nothing shows, and what a T-pose has no say in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.body_calibration.joint_variability import transient_variance_shares
from bodycap_batch.merging.body_calibration.mount_calibration_graph import JOINT_PRIOR_SCALE
from bodycap_batch.synthetic import SynthOptions
from tests.calibrations import calibration_of

EVERYDAY = 0.75
"""Part of the everyday variance that varies within a capture."""


@pytest.fixture(scope="module")
def solved():
    """Three cameras on a walk of 20 s, calibrated at the true scale."""
    samples, calibration, metric = calibration_of(SynthOptions(seconds=20.0, outliers=0.0, poses_only=True))
    calibration.solve(metric)
    return calibration.linearised(), samples.times_ns


def _shares(mounts, times_ns, redundancy=None):
    found = mounts.reduced()
    if redundancy is not None:
        found = replace(found, redundancy=np.full_like(found.redundancy, redundancy))
    return transient_variance_shares(mounts, found, np.arange(len(times_ns)), times_ns, JOINT_PRIOR_SCALE)


def test_a_calm_walker_uses_a_part_of_the_everyday_variance(solved):
    mounts, times_ns = solved
    shares = dict(zip((bone.role for bone in mounts.body.bones), _shares(mounts, times_ns), strict=True))
    # Five gestures, about half of what counts; arms swing by 11 degrees and reach by 40: 40 are one sigma.
    assert 0.2 < shares["LeftArm"] < 0.8 * EVERYDAY
    # One part in eight of the shoulder girdle's turns shows, two of fifteen, against six that are believed.
    assert shares["LeftShoulder"] > 0.75 * EVERYDAY


def test_an_unobserved_joint_keeps_its_everyday_variance(solved):
    mounts, times_ns = solved
    silent = replace(mounts, linear=replace(mounts.linear, rhs=np.zeros_like(mounts.linear.rhs)))
    assert _shares(silent, times_ns, redundancy=0.0) == pytest.approx(EVERYDAY)
    # A joint that rests although each of five gestures could have shown it: 6 believed against 15 seen.
    assert _shares(silent, times_ns, redundancy=1.0)[1:] == pytest.approx(EVERYDAY * 6.0 / 21.0, rel=0.05)


def test_larger_movements_give_a_larger_variance(solved):
    mounts, times_ns = solved
    wild = replace(mounts, linear=replace(mounts.linear, rhs=10.0 * mounts.linear.rhs))
    assert (_shares(wild, times_ns)[1:] > _shares(mounts, times_ns)[1:]).all()
    assert _shares(wild, times_ns).max() > 1.0


def test_a_t_pose_alone_gives_the_everyday_variance(solved):
    mounts, times_ns = solved
    none = np.zeros(0, dtype=np.int64)
    assert transient_variance_shares(
        mounts, mounts.reduced(), none, times_ns[:0], JOINT_PRIOR_SCALE
    ) == pytest.approx(EVERYDAY)
