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
