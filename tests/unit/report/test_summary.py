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


def metrics(gap_s: float = 0.0, scale: float = 0.01, residual_m: float = 0.001) -> dict[str, object]:
    return {
        "frame": "world",
        "total": {
            "coverage": 1.0, "frames": 10, "frames_registered": 10, "mean_reprojection_error_px": 0.5,
        },
        "cameras": {"torso": {"coverage": 1.0, "frames": 10, "frames_registered": 10, "frame": "world"}},
        "merge": {
            "scale": {"relative_sigma": scale},
            "cameras": {"torso": {"longest_gap_s": gap_s, "residual_m": {"p95": residual_m}}},
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
    summary = summarise(metrics(residual_m=0.05, scale=0.05))
    assert summary.grade == Grade.POOR
    assert [doubt.split(":")[:2] for doubt in summary.doubts] == [
        ["poor", " Distance between cameras and body"],
        ["usable with care", " Metric scale"],
    ]
    assert summary.lines()[0] == f"verdict: poor. {summary.headline}"
    assert "the motion is poor" in summary.headline


def test_the_headline_names_the_size_and_what_makes_it_known() -> None:
    values = metrics(scale=0.06)
    sources = [{"name": "mean stature", "used": True}]
    values["merge"]["scale"] |= {"sources": sources}  # type: ignore[index]
    values["merge"]["mounts"] = {  # type: ignore[index]
        name: {"role": role, "sigma_deg": 2.0, "sigma_m": 0.01}
        for name, role in (("torso", "Spine1"), ("left_palm", "LeftHand"))
    }
    headline = summarise(values).headline
    assert headline.startswith(
        "The cameras are good (100.0 % of the frames), but the motion is usable with care."
    )
    assert (
        "Sizes are known to about ± 10 cm of body height (6.0 %): give the height of the person" in headline
    )


def test_what_is_missing_costs_coverage_and_no_grade() -> None:
    values = metrics(gap_s=5.0)
    values["cameras"]["left_palm"] = {  # type: ignore[index]
        **values["cameras"]["torso"], "frames_registered": 4, "coverage": 0.4, "seconds": 2.0,  # type: ignore[index]
    }  # fmt: skip
    verdict = judge(values, None)
    assert (verdict.cameras, verdict.body) == (Grade.GOOD, Grade.GOOD)
    assert verdict.coverage is not None
    found = verdict.coverage.to_dict()
    assert (found["share"], found["frames"], found["frames_delivered"]) == (0.7, 20, 14)
    assert found["cameras"]["left_palm"]["seconds_delivered"] == 0.8
    assert found["seconds"] is None, "the duration of one video is not known"
    assert "(70.0 % of the frames; left_palm 40.0 %)" in verdict.headline


@pytest.mark.parametrize(
    ("frame", "advice"),
    [
        ("a1b2", "check that the video is of this recording"),
        ("main", "clap once"),
    ],
    ids=["another room", "the same room"],
)
def test_the_advice_about_an_unknown_clock_depends_on_the_map(frame: str, advice: str) -> None:
    """A clap alone does not help if the video shows another room."""
    values = metrics()
    values["cameras"]["left_palm"] = {**values["cameras"]["torso"], "frame": frame}  # type: ignore[index]
    values["models"] = [{"frame": "world"}, {"frame": "a1b2"}]
    values["clocks"] = {"torso": {"source": "common"}, "left_palm": {"source": "none"}}
    verdict = judge(values, None)
    assert advice in verdict.headline
    assert ("is of this recording" in verdict.headline) == (frame != "main")
    assert verdict.coverage is not None
    assert verdict.coverage.cameras["left_palm"].delivered == 0
    assert verdict.coverage.cameras["left_palm"].reason
    assert verdict.coverage.share == 0.5


def test_a_camera_that_fell_off_is_named_in_the_coverage() -> None:
    values = metrics(gap_s=2.5)
    values["merge"]["still_cameras"] = {"torso": {"from_s": 2.5, "to_s": 5.0}}  # type: ignore[index]
    verdict = judge(values, None)
    assert verdict.grade is Grade.GOOD
    assert verdict.coverage is not None
    assert "stands still in the room between 2.5 s and 5.0 s" in verdict.coverage.cameras["torso"].reason
    assert any(each.action.startswith("Fasten torso") for each in verdict.coverage.advice)


def test_a_strap_that_slipped_is_named_with_advice() -> None:
    values = metrics()
    assert not any(each.name == "Straps" for each in judge(values, None).criteria)
    says = "the mount of left_palm slipped 4.2 s after the start of the motion"
    values["merge"]["slipped_mounts"] = {"cameras": {"left_palm": {}}, "says": says}  # type: ignore[index]
    (found,) = (each for each in judge(values, None).criteria if each.name == "Straps")
    assert (found.grade, found.finding) == (Grade.FAIR, says)
    assert found.advice is not None
    assert found.advice.action.startswith("Tighten the strap of left_palm")


def test_warnings_about_the_skeleton_file_are_doubts() -> None:
    values = metrics()
    skeleton: dict[str, list[str]] = {"notes": ["up is +Z"], "warnings": []}
    values["merge"]["skeleton"] = skeleton  # type: ignore[index]
    assert not any("up is +Z" in doubt for doubt in summarise(values).doubts)
    skeleton["warnings"] = ["the toes point back"]
    assert any("the toes point back; up is +Z" in doubt for doubt in summarise(values).doubts)


def test_a_good_result_names_no_criterion() -> None:
    assert summarise(metrics()).doubts == ()


def test_a_folder_without_metrics_has_no_summary(tmp_path: Path) -> None:
    assert summary_of_folder(tmp_path) is None
    (tmp_path / "metrics.json").write_text("{")
    assert summary_of_folder(tmp_path) is None
    (tmp_path / "metrics.json").write_text(json.dumps(metrics(0.0, 0.01)))
    assert summary_of_folder(tmp_path) is not None
