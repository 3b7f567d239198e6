"""Paths of values in metrics.json, also with names that hold a dot."""

from __future__ import annotations

import pytest

from bodycap_batch.report.metric_paths import metric_at, metric_path


@pytest.mark.parametrize("name", ["torso", "torso.back", "a.b.c", ".", "a\\.b", "a\\"])
def test_a_name_with_any_characters_is_found_again(name: str) -> None:
    metrics = {"cameras": {name: {"maps": [{"error": 1.0}, {"error": 2.0}]}, "torso.": {}, "a": {"b": 3}}}
    assert metric_at(metrics, metric_path("cameras", name, "maps", 1, "error")) == 2.0
    assert metric_at(metrics, metric_path("cameras", name, "maps", 2, "error")) is None
    assert metric_at(metrics, metric_path("cameras", f"{name}.x", "maps")) is None


def test_a_path_without_dots_in_its_names_is_plain() -> None:
    assert metric_path("merge", "scale", "sources", 0, "off") == "merge.scale.sources.0.off"
