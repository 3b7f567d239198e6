"""Drawn rolling-shutter captures of the benchmark, and its figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.bench import shutter


def recording(folder: Path, name: str, seconds: float) -> None:
    """Write the part of a BVH file that holds its duration."""
    text = f"HIERARCHY\nMOTION\nFrames: {round(seconds * 100)}\nFrame Time: 0.01\n"
    (folder / name).write_text(text, encoding="utf-8")


def result(rms_m: float) -> dict[str, Any]:
    total = {"registered": 80, "frames": 90, "ate_m": {"rmse": rms_m, "max": 3 * rms_m}}
    return {"exit": 0, "report": {"trajectories": {"total": total}}}


def test_drawn_readout_times_are_spread_over_the_range(tmp_path: Path) -> None:
    recording(tmp_path, "long.bvh", 6.0)
    recording(tmp_path, "short.bvh", 2.0)
    cases = shutter.drawn_cases(6, 3, tmp_path, 3.0)
    assert cases == shutter.drawn_cases(6, 3, tmp_path, 3.0)
    assert cases != shutter.drawn_cases(6, 4, tmp_path, 3.0)
    part_s = shutter.MAX_READOUT_S / 6
    assert sorted(int(case.readout_s / part_s) for case in cases) == [0, 1, 2, 3, 4, 5]
    motions = {case.name.split("_", 2)[2] for case in cases}
    assert motions == {"long", "simple", "gait"}


def test_figures_of_a_capture_and_its_twin() -> None:
    case = shutter.Case(name="one", readout_s=0.012, options=())
    outcome = shutter.Outcome(
        case=case,
        rolling=result(0.006),
        twin=result(0.003),
        readouts={
            "torso": (0.0125, 0.0005, "estimated", 0.0125),
            "palm": (0.0, 0.0005, "none found", 0.0105),
        },
        twin_readouts={"torso": (0.004, 0.0005, "estimated", 0.004)},
    )
    assert shutter.ratio(outcome) == pytest.approx(2.0)
    text = "\n".join(shutter.lines_of(outcome))
    assert "80/90  ATE 0.60 cm, worst 1.8" in text
    assert "torso: 12.50 ± 0.50 ms (estimated), +1.0 sigma" in text
    lines = shutter.summary([outcome])
    assert "in 0;" in lines[0]
    assert "50% inside 2 sigma" in lines[1]
    assert "2 ms or more: 1; found although global: 1" in lines[2]


def test_a_readout_that_is_not_determined_has_no_finite_sigma(tmp_path: Path) -> None:
    unknown = {"seconds": 0.0, "sigma_s": None, "source": "not determined", "best_s": 0.01}
    refined = {"seconds": 0.012, "sigma_s": 0.0005, "source": "estimated", "best_s": 0.012}
    metrics = {
        "mapping": {
            "readouts_from_matches": {"palm": unknown, "torso": unknown},
            "rolling_shutter": [{"torso": refined}],
        }
    }
    (tmp_path / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    assert shutter.readouts_in(tmp_path) == {
        "palm": (0.0, float("inf"), "not determined", 0.01),
        "torso": (0.012, 0.0005, "estimated", 0.012),
    }
