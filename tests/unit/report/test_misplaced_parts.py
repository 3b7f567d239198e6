"""A part that contradicts the map lowers the grade of the cameras."""

from __future__ import annotations

from typing import Any

import pytest

from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import judge


def _metrics(misplaced: dict[str, list[int]]) -> dict[str, Any]:
    camera = {"coverage": 1.0, "frames": 300, "frames_registered": 300, "frame": "map-0", "keyframes": 90}
    return {
        "frame": "map-0",
        "total": {**camera, "mean_reprojection_error_px": 0.4},
        "cameras": {"torso": dict(camera), "left_palm": dict(camera)},
        "mapping": {"misplaced_keyframes": misplaced},
    }


@pytest.mark.parametrize(
    ("frames", "grade"),
    [
        ([], Grade.GOOD),
        ([17], Grade.GOOD),
        (list(range(30, 36)), Grade.GOOD),
        (list(range(30, 45)), Grade.FAIR),
    ],
)
def test_a_large_misplaced_part_is_never_good(frames: list[int], grade: Grade) -> None:
    verdict = judge(_metrics({"left_palm": frames}), None)
    assert verdict.cameras is grade
    found = [item for item in verdict.criteria if item.name == "Parts that contradict the map"]
    assert len(found) == bool(frames)
    count = "one keyframe" if len(frames) == 1 else f"{len(frames)} keyframes"
    assert all(item.finding.startswith(f"left_palm: {count} (") for item in found)


def test_a_map_without_the_check_has_no_such_criterion() -> None:
    metrics = _metrics({})
    metrics["mapping"] = {}
    assert judge(metrics, None).cameras is Grade.GOOD


@pytest.mark.parametrize(
    ("main", "further", "grade"),
    [(0, 0, Grade.GOOD), (2, 0, Grade.GOOD), (5, 0, Grade.FAIR), (0, 20, Grade.POOR), (40, 0, Grade.POOR)],
)
def test_frames_that_the_video_contradicts_lower_the_grade_in_all_maps(
    main: int, further: int, grade: Grade
) -> None:
    metrics = _metrics({})
    metrics["models"] = [{"frame": "map-0"}, {"frame": "map-7"}]
    metrics["mapping"]["links"] = {
        "torso": [
            {"frame": "map-0", "compared": 120, "contradicted": main, "contradicted_frames": [4, 30]},
            {"frame": "map-7", "compared": 30, "contradicted": further, "contradicted_frames": [180, 230]},
        ],
        "left_palm": [],
    }
    verdict = judge(metrics, None)
    assert verdict.cameras is grade
    (found,) = (item for item in verdict.criteria if item.name == "Links of the video")
    assert found.value == (main + further) / 150
    assert ("frames 4 to 30" in found.finding) == bool(main)
    assert ("frames 180 to 230 in map_1" in found.finding) == bool(further)
