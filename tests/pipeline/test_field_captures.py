"""Whole jobs on captures as cameras in the field record them, scored against the exact truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.altered import AS_A_PHONE, alter, covered, slower, zoomed
from tests.pipeline.hard_captures import (
    MAX_ATE_M,
    MIN_ATE_M,
    MIN_COVERAGE,
    render,
    rows_of,
    run,
    score,
)

pytestmark = pytest.mark.slow

COVERED_S = {"torso": (0.0, 0.6), "left_palm": (1.5, 2.3)}
RECORDED = {
    "phones": dict.fromkeys(COVERED_S, AS_A_PHONE),
    "covered": {name: covered(span) for name, span in COVERED_S.items()},
    "rates": {"left_palm": slower(2, (240, 180))},
    "zoomed": {"left_palm": zoomed(0.75)},
}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("walk"), seed=7, cameras=tuple(COVERED_S))


@pytest.mark.parametrize("how", RECORDED)
def test_what_cameras_in_the_field_record_is_registered_and_right(
    how: str, walk: Path, tmp_path: Path
) -> None:
    capture = alter(walk, tmp_path / "capture", RECORDED[how])
    assert run(capture) == 0
    report, rows = score(capture), rows_of(capture)
    hidden = [row for row in rows if how == "covered" and _in(float(row["time"]), COVERED_S[row["camera"]])]
    assert len(hidden) == (42 if how == "covered" else 0)
    assert not any(row["status"] in ("REGISTERED", "KEYFRAME") for row in hidden)
    assert report.total.registered >= MIN_COVERAGE * (len(rows) - len(hidden))
    assert report.total.ate_m is not None
    assert MIN_ATE_M < report.total.ate_m.rmse < MAX_ATE_M


def _in(time_s: float, span_s: tuple[float, float]) -> bool:
    return span_s[0] <= time_s < span_s[1]
