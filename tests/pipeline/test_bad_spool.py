"""Every broken job of the table in one spool: each is filed away with its reason, and no other suffers."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.broken import CASES, Case
from tests.pipeline.fake_stages import ORDERS
from tests.pipeline.spools import SpoolBench

pytestmark = pytest.mark.slow

FIRST, LAST = "0 sound", "z sound"
IN_A_SPOOL = {
    "results' name is a file": None,  # results go to the spool's own folder, whatever the job says
    "name of 300 letters": 2,
}


def folder_of(case: Case) -> str:
    return case.name.replace("'", "")


@pytest.fixture(scope="module")
def worked_off(tmp_path_factory: pytest.TempPathFactory, sound_folder: Path) -> SpoolBench:
    """Two sound jobs with all broken ones between them; the videos are really looked at."""
    folder = tmp_path_factory.mktemp("spool")
    with pytest.MonkeyPatch.context() as monkeypatch:
        bench = SpoolBench(folder)
        bench.order(real=["check"])
        monkeypatch.setenv(ORDERS, str(bench.orders))
        monkeypatch.chdir(folder)
        for name in (FIRST, LAST):
            _drop(bench, sound_folder, name, None)
        for case in CASES:
            _drop(bench, sound_folder, folder_of(case), case)
        bench.work_off(jobs=2)
    return bench


def _drop(bench: SpoolBench, sound_folder: Path, name: str, case: Case | None) -> None:
    made = Path(shutil.copytree(sound_folder, bench.folder / "making" / name))
    if case is not None:
        case.break_it(made)
    (made / "READY").touch()
    made.rename(bench.spool.inbox / name)


@pytest.mark.parametrize("name", [FIRST, LAST])
def test_the_valid_jobs_are_done(worked_off: SpoolBench, name: str) -> None:
    assert worked_off.status(name)["state"] == "done"
    assert (worked_off.job(name).result / "metrics.json").is_file()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_broken_job_is_filed_under_failed_with_its_reason(worked_off: SpoolBench, case: Case) -> None:
    status = worked_off.status(folder_of(case))
    code = IN_A_SPOOL.get(case.name, case.code)
    if code is None:
        assert status["state"] == "done"
        return
    assert status["state"] == "failed", status
    assert status["exit_code"] == code, status["error"]
    error = status["error"]
    assert case.message in error["message"]
    assert Path(error["path"]).name == case.file
    assert error["hint"]
    assert status["stage"] in ("", "check")
    assert worked_off.job(folder_of(case)).path.parent == worked_off.spool.root / "failed"


def test_nothing_is_left_waiting_or_running(worked_off: SpoolBench) -> None:
    assert list(worked_off.spool.inbox.iterdir()) == []
    assert list(worked_off.spool.running.iterdir()) == []
