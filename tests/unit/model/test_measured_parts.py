"""Spans in which the cameras did not measure a part of the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.model.measured_parts import BODY_PARTS, PartState, part_spans
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
