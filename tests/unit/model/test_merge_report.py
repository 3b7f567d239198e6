"""The report of the merging stage: its plain values, and how they are read back."""

from __future__ import annotations

import math

from bodycap_batch.model.merge_report import MergeReport, Percentiles

STORED = {
    "scale": {
        "source": "height",
        "relative_sigma": 0.05,
        "sources": [{"name": "height", "metres_per_map_unit": 2.0, "used": True}],
        "body_alone": {"costs": [[1.0, 2.5], [1.1, 3.0]]},
    },
    "t_pose": {"from_s": 0.5, "to_s": 2.0},
    "mounts": {"torso": {"role": "Spine1", "joint_from_cam": [[1.0, 0.0], [0.0, 1.0]]}},
    "exchanged_sides": {"cameras": {"left_palm": 1.0}, "says": "swapped"},
    "joint_sigma_m": {"LeftHand": {"observed": {"p50": 0.01, "p95": 0.02}}},
    "a key of another version": 1,
}


def test_stored_values_are_read_as_types() -> None:
    report = MergeReport.from_dict(STORED)
    assert report.scale.sources[0].metres_per_map_unit == 2.0
    assert report.scale.body_alone.costs == ((1.0, 2.5), (1.1, 3.0))
    assert report.exchanged_sides is not None
    assert report.exchanged_sides.cameras == {"left_palm": 1.0}
    assert report.joint_sigma_m["LeftHand"]["observed"] == Percentiles(p50=0.01, p95=0.02)


def test_missing_values_are_empty() -> None:
    report = MergeReport.from_dict({})
    assert report.scale.source == ""
    assert math.isnan(report.scale.relative_sigma)
    assert report.t_pose is None
    assert report.exchanged_sides is None
    assert report.mounts == {}


def test_values_without_content_keep_their_keys() -> None:
    values = MergeReport.from_dict({"mounts": {"torso": {}}}).to_dict()
    assert values["exchanged_sides"] == {}
    assert values["t_pose"] is None
    # These keys exist only if a roll was searched.
    assert not {"roll_deg", "roll_runner_up"} & set(values["mounts"]["torso"])


def test_plain_values_are_read_back_without_a_change() -> None:
    values = MergeReport.from_dict(STORED).to_dict()
    assert values["mounts"]["torso"]["joint_from_cam"] == [[1.0, 0.0], [0.0, 1.0]]
    assert str(MergeReport.from_dict(values).to_dict()) == str(
        values
    )  # as text, because NaN differs from NaN
    assert list(values)[:4] == ["scale", "t_pose", "up", "floor"]
