"""Compare paths in files with true paths."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from bodycap_batch.evaluate import Alignment, TrajectoryReport, score_trajectories
from bodycap_batch.formats.tum import read_tum


def evaluate_trajectories(
    estimates: Mapping[str, Path],
    truths: Mapping[str, Path],
    align: Alignment = "sim3",
    frames: Mapping[str, int] | None = None,
) -> TrajectoryReport:
    """Compare estimated paths with true paths, both given as TUM files by camera name."""
    return score_trajectories(
        {name: read_tum(path) for name, path in estimates.items()},
        {name: read_tum(path) for name, path in truths.items()},
        align,
        frames,
    )
