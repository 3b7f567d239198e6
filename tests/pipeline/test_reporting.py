"""The stored results that a report is made from, for `bodycap view` and its recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.cli.look import _StoredMarks
from bodycap_batch.core.errors import StoreError
from bodycap_batch.pipeline import Settings, remake_report, stored_for_report
from bodycap_batch.store.artefacts import Store
from tests.pipeline.test_run import CAMERAS, Bench


def looking(bench: Bench) -> Settings:
    """Settings with which every computation fails."""
    return Settings(
        store=Store(bench.folder / "store"),
        threads=1,
        listener=lambda _: None,
        cancelled=lambda: False,
        command=("false",),
    )


def test_finished_stages_are_found_and_nothing_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, monkeypatch)
    bench.run()
    found = stored_for_report(bench.job(), out_dir=bench.out, settings=looking(bench))
    assert all(item is not None and item.path.is_dir() for item in (found.map, found.merge, found.export))
    assert len(found.registrations) == len(found.keyframes) == len(CAMERAS)
    assert found.failure is None
    # another option of the skeleton: its stage and the export are not there, what comes before is
    found = stored_for_report(bench.job(merge={"max_gap_s": 0.5}), out_dir=bench.out, settings=looking(bench))
    assert found.merge is None
    assert found.export is None
    assert len(found.registrations) == len(CAMERAS)
    assert found.failure is not None
    assert found.failure["stage"] == "merge"


def test_an_empty_store_gives_no_marks_and_one_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(tmp_path, monkeypatch)
    marks = _StoredMarks(bench.job(), bench.out, tmp_path / "nothing")
    assert marks("torso", 0) == []
    assert marks("torso", 60) == []
    assert capsys.readouterr().err.count("only over the pictures in the report") == 1


def test_the_report_of_results_of_other_options_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An update of the program changes the keys of the stages as other options do."""
    bench = Bench(tmp_path, monkeypatch)
    bench.run()
    before = (bench.out / "report.html").read_bytes()
    job = bench.job(merge={"max_gap_s": 0.5})
    with pytest.raises(StoreError, match=r"their report stays as it is: these stages .* merge"):
        remake_report(job, out_dir=bench.out, settings=looking(bench))
    assert (bench.out / "report.html").read_bytes() == before
    assert not (bench.out / "partial").exists()
