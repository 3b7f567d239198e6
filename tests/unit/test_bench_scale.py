"""The benchmark of the metric scale: its draws and the comparison with the truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.scale import Outcome, drawn_options, scale_of, summary


def test_a_drawn_capture_does_not_depend_on_the_number_of_captures(tmp_path: Path) -> None:
    few, many = (list(drawn_options(number, 3, tmp_path)) for number in (2, 6))
    assert few == many[:2]
    assert len({settings.seed for _, settings in many}) == 6


def test_the_summary_counts_scales_inside_two_sigmas() -> None:
    rows = [Outcome(name="a", seconds=5.0, error=error, sigma=0.1) for error in (0.15, -0.25, 0.0)]
    assert "2 of 3 inside 2 sigma" in summary("walk", rows)


@pytest.mark.slow
def test_the_scale_of_a_drawn_walk_is_within_its_sigmas(tmp_path: Path) -> None:
    found = scale_of(*next(drawn_options(1, 3, tmp_path)))
    assert 0.0 < found.sigma < 0.3
    assert abs(found.error) < 3.0 * found.sigma
