"""The verdict in a few lines."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.report.grades import Grade
from bodycap_batch.report.summary import measured_parts, summarise, summary_of_folder
from bodycap_batch.report.verdict import judge

LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
ROLES = ("Hips", "Spine1", "Head", *(side + limb for side in ("Left", "Right") for limb in LIMBS))


def joints(*observed: str) -> dict[str, dict[str, object]]:
    shares = {role: float(role in observed) for role in ROLES}
    return {
        f"bone {role}": {"role": role, "observed": share > 0, "observed_share": share}
        for role, share in shares.items()
    }


def metrics(gap_s: float, scale: float) -> dict[str, object]:
    return {
        "frame": "world",
        "total": {
            "coverage": 1.0, "frames": 10, "frames_registered": 10, "mean_reprojection_error_px": 0.5,
        },
        "cameras": {"torso": {"coverage": 1.0, "frames": 10, "frames_registered": 10, "frame": "world"}},
        "merge": {
            "scale": {"relative_sigma": scale},
            "cameras": {"torso": {"longest_gap_s": gap_s, "residual_m": {"p95": 0.02}}},
        },
        "motion": {"joints": {}},
    }  # fmt: skip


def test_parts_of_the_body_are_named_in_words() -> None:
    measured, rest = measured_parts(
        joints("Spine1", "LeftArm", "LeftForeArm", "RightArm", "RightForeArm", "LeftHand", "LeftUpLeg")
    )
    assert measured == ("chest", "both arms", "left hand", "left thigh")
    assert rest == ("hips", "head", "right hand", "left shin", "right leg", "both feet")


def test_the_worst_two_criteria_are_named_the_worst_first() -> None:
    summary = summarise(metrics(gap_s=5.0, scale=0.05))
    assert summary.grade == Grade.POOR
    assert [doubt.split(":")[:2] for doubt in summary.doubts] == [
        ["poor", " Longest gap"],
        ["usable with care", " Metric scale"],
    ]
    assert summary.lines()[0] == f"verdict: poor. {summary.headline}"
    assert "the motion is poor" in summary.headline


@pytest.mark.parametrize(
    ("frame", "advice", "place"),
    [
        ("a1b2", "check that the video is of this recording", "not in the main map: left_palm"),
        ("main", "clap once", "not part of the body"),
    ],
    ids=["another room", "the same room"],
)
def test_the_advice_about_an_unknown_clock_depends_on_the_map(frame: str, advice: str, place: str) -> None:
    """A clap alone does not help if the video shows another room."""
    values = metrics(gap_s=0.0, scale=0.01)
    values["cameras"]["left_palm"] = {**values["cameras"]["torso"], "frame": frame}  # type: ignore[index]
    values["models"] = [{"frame": "world"}, {"frame": "a1b2"}]
    values["clocks"] = {"torso": {"source": "common"}, "left_palm": {"source": "none"}}
    verdict = judge(values, None)
    assert advice in verdict.headline
    assert ("is of this recording" in verdict.headline) == (frame != "main")
    (room,) = (item for item in verdict.criteria if item.name == "One room")
    assert room.grade is Grade.POOR
    assert place in room.finding


def test_a_camera_that_fell_off_is_named_before_the_gap_that_it_leaves() -> None:
    values = metrics(gap_s=2.5, scale=0.01)
    values["merge"]["still_cameras"] = {"left_palm": {"from_s": 2.5, "to_s": 5.0}}  # type: ignore[index]
    summary = summarise(values)
    assert summary.grade is Grade.POOR
    assert "left_palm stands still in the room between 2.5 s and 5.0 s" in summary.doubts[0]


def test_warnings_about_the_skeleton_file_are_doubts() -> None:
    values = metrics(gap_s=0.0, scale=0.01)
    skeleton: dict[str, list[str]] = {"notes": ["up is +Z"], "warnings": []}
    values["merge"]["skeleton"] = skeleton  # type: ignore[index]
    assert not any("up is +Z" in doubt for doubt in summarise(values).doubts)
    skeleton["warnings"] = ["the toes point back"]
    assert any("the toes point back; up is +Z" in doubt for doubt in summarise(values).doubts)


def test_a_good_result_names_no_criterion() -> None:
    values = metrics(gap_s=0.0, scale=0.01)
    values["merge"]["cameras"]["torso"]["residual_m"]["p95"] = 0.001  # type: ignore[index]
    assert summarise(values).doubts == ()


def test_a_folder_without_metrics_has_no_summary(tmp_path: Path) -> None:
    assert summary_of_folder(tmp_path) is None
    (tmp_path / "metrics.json").write_text("{")
    assert summary_of_folder(tmp_path) is None
    (tmp_path / "metrics.json").write_text(json.dumps(metrics(0.0, 0.01)))
    assert summary_of_folder(tmp_path) is not None
