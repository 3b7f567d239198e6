"""How a job's tasks share the cores."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.config.models import Job
from bodycap_batch.pipeline import Settings
from bodycap_batch.pipeline.flow import Flow
from bodycap_batch.store import Store


@pytest.mark.parametrize(
    ("cameras", "threads", "expected"),
    [
        (1, 2, [2]),
        (2, 2, [1, 1]),
        (3, 2, [1, 1, 2]),  # the third runs when the others are done
        (5, 2, [1, 1, 1, 1, 2]),
        (3, 8, [2, 2, 2]),
        (3, 1, [1, 1, 1]),
    ],
)
def test_the_last_cameras_share_all_threads(
    tmp_path: Path, cameras: int, threads: int, expected: list[int]
) -> None:
    names = [f"camera {number}" for number in range(cameras)]
    blocks = [{"name": name, "video": [f"/{name}.mp4"]} for name in names]
    job = Job.model_validate({"capture": {"cameras": blocks}, "name": "walk", "skeleton": "none"})
    settings = Settings(
        store=Store(tmp_path), threads=threads, listener=lambda _: None, cancelled=lambda: False
    )
    assert Flow(job, settings, logs=tmp_path / "out" / "logs")._shares() == expected
