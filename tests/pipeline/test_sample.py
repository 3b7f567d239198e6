"""The sample capture of a job: rendered once, complete or not there."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.core.errors import EstimationError, JobError
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline import Settings, prepare_capture
from bodycap_batch.store.artefacts import Store
from tests.pipeline.fake_stages import ORDERS

CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))
CAMERAS = ["torso", "left_palm"]


class Bench:
    def __init__(self, root: Path) -> None:
        self.store = root / "store"
        self.folder = root / "examples" / "lab"
        self.events: list[Event] = []

    def prepare(self, **options: Any) -> list[str]:
        """Prepare, and list what happened."""
        self.events.clear()
        settings = Settings(
            store=Store(self.store),
            threads=2,
            listener=self.events.append,
            cancelled=lambda: False,
            command=CHILD,
        )
        prepare_capture({"cameras": CAMERAS, **options}, self.folder, settings)
        return [event.kind for event in self.events if event.kind != "progress"]

    def names(self) -> set[str]:
        return {p.relative_to(self.folder).as_posix() for p in self.folder.rglob("*") if p.is_file()}


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_it_is_rendered_once(bench: Bench) -> None:
    assert bench.prepare(seconds=3) == ["started", "finished"]
    assert bench.names() >= {"torso.mp4", "left_palm.mp4", "gt/torso.tum"}
    assert bench.prepare(seconds=3) == []


def test_a_lost_file_comes_back_from_the_store(bench: Bench) -> None:
    bench.prepare()
    (bench.folder / "torso.mp4").unlink()
    assert bench.prepare() == ["reused"]
    assert (bench.folder / "torso.mp4").is_file()


def test_a_lost_store_is_no_reason_to_render_again(bench: Bench) -> None:
    bench.prepare()
    shutil.rmtree(bench.store)
    assert bench.prepare() == []


def test_other_options_render_another_capture(bench: Bench) -> None:
    bench.prepare(seconds=3)
    assert bench.prepare(seconds=4) == ["started", "finished"]
    assert (bench.folder / "torso.mp4").read_text() == "torso for 4.0 s"


def test_another_motion_of_the_same_name_renders_another_capture(bench: Bench, tmp_path: Path) -> None:
    motion = tmp_path / "walk.bvh"
    motion.write_text("HIERARCHY one")
    bench.prepare(motion=str(motion))
    motion.write_text("HIERARCHY two")
    assert bench.prepare(motion=str(motion)) == ["started", "finished"]


def test_files_of_other_names_stay(bench: Bench) -> None:
    bench.folder.mkdir(parents=True)
    (bench.folder / "mine.txt").write_text("mine")
    bench.prepare()
    assert (bench.folder / "mine.txt").read_text() == "mine"


def test_a_failure_leaves_no_half_capture(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders = tmp_path / "orders.json"
    orders.write_text('{"fail": "synth"}')
    monkeypatch.setenv(ORDERS, str(orders))
    with pytest.raises(EstimationError):
        bench.prepare()
    assert not any(name.endswith(".mp4") for name in bench.names())
    orders.write_text("{}")
    assert bench.prepare() == ["started", "finished"]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"secnods": 3}, "capture.synthetic.secnods"),
        ({"seconds": -1}, "capture.synthetic.seconds"),
        ({"motion": os.devnull + "/nothing.bvh"}, "capture.synthetic.motion"),
    ],
)
def test_wrong_options_are_named(bench: Bench, options: dict[str, Any], field: str) -> None:
    with pytest.raises(JobError) as caught:
        bench.prepare(**options)
    assert caught.value.field == field
    assert bench.events == []
