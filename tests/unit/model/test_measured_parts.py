"""Spans in which the cameras did not measure a part of the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.model.measured_parts import (
    BODY_PARTS,
    JointSource,
    PartState,
    filled_branches,
    joint_sources,
    part_spans,
)
from tests.bodies import reaching


def test_spans_of_each_part() -> None:
    motion = reaching(60)
    observed = np.zeros_like(motion.observed)
    for role in ("LeftArm", "LeftForeArm", "LeftHand", "RightArm"):
        observed[:, motion.skeleton.roles.index(role)] = True
    observed[20:40, motion.skeleton.roles.index("LeftHand")] = False
    observed[50, motion.skeleton.roles.index("LeftArm")] = False  # too short for a span
    spans = part_spans(replace(motion, observed=observed))
    assert {span.part for span in spans} == set(BODY_PARTS)
    left = [(span.state, span.first, span.last) for span in spans if span.part == "left arm"]
    assert left == [
        (PartState.MEASURED, 0, 19),
        (PartState.PARTLY, 20, 39),
        (PartState.MEASURED, 40, 59),
    ]
    (leg,) = [span for span in spans if span.part == "left leg"]
    assert (leg.state, leg.first, leg.last) == (PartState.UNMEASURED, 0, 59)
    (right,) = [span for span in spans if span.part == "right arm"]
    assert right.state is PartState.PARTLY


def test_a_filled_joint_that_carries_a_measured_one_is_in_no_filled_branch() -> None:
    motion = reaching(20)
    names = motion.skeleton.joints
    observed = np.zeros_like(motion.observed)
    observed[5:9, names.index("LeftForeArm")] = True
    observed[:, names.index("RightLeg")] = True
    seen = replace(motion, observed=observed)
    measured = {name for name, source in zip(names, joint_sources(seen), strict=True) if source == "measured"}
    assert measured == {"LeftForeArm", "RightLeg"}
    assert set(joint_sources(seen)) == set(JointSource)
    branches = {name for name, removable in zip(names, filled_branches(seen), strict=True) if removable}
    assert {"LeftHand", "RightArm", "RightHand", "Head", "LeftUpLeg", "LeftFoot", "RightFoot"} <= branches
    assert branches.isdisjoint({"Hips", "Spine", "LeftArm", "LeftForeArm", "RightUpLeg", "RightLeg"})
    # Any other pose of these joints leaves all others where they are.
    turned = seen.local_rotation.copy()
    turned[:, filled_branches(seen)] = np.eye(3)
    before, after = seen.world_from_joint(), replace(seen, local_rotation=turned).world_from_joint()
    assert not np.allclose(before, after)
    np.testing.assert_allclose(after[:, ~filled_branches(seen)], before[:, ~filled_branches(seen)])
