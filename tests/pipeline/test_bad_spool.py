"""Every broken job of the table in one spool: each is filed with its reason, and delays no other."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.broken import CASES, Case
from tests.pipeline.fake_stages import ORDERS
from tests.pipeline.spools import SpoolFixture

pytestmark = pytest.mark.slow

FIRST, LAST = "0 sound", "z sound"
IN_A_SPOOL = {
    "results' name is a file": None,  # the spool decides where the results go, not the job
    "name of 300 letters": 2,
}

MESSAGES_IN_A_SPOOL = {
    "power lost": "bytes are there, and no index (moov)",
    "copy broken off": "its end is missing",
}
"""A watched folder waits for such a file, and then names what is missing, before it opens any video."""


def folder_of(case: Case) -> str:
    return case.name.replace("'", "")


@pytest.fixture(scope="module")
def finished_spool(tmp_path_factory: pytest.TempPathFactory, sound_folder: Path) -> SpoolFixture:
    """Run two valid jobs with all broken ones between them; the real check inspects the videos."""
    folder = tmp_path_factory.mktemp("spool")
    with pytest.MonkeyPatch.context() as monkeypatch:
        bench = SpoolFixture(folder)
        bench.order(real=["check"])
        monkeypatch.setenv(ORDERS, str(bench.orders))
        monkeypatch.chdir(folder)
        for name in (FIRST, LAST):
            _drop(bench, sound_folder, name, None)
        for case in CASES:
            _drop(bench, sound_folder, folder_of(case), case)
        bench.run_once(jobs=2)
    return bench


def _drop(bench: SpoolFixture, sound_folder: Path, name: str, case: Case | None) -> None:
    made = Path(shutil.copytree(sound_folder, bench.folder / "making" / name))
    if case is not None:
        case.break_it(made)
    (made / "READY").touch()
    made.rename(bench.spool.inbox / name)


@pytest.mark.parametrize("name", [FIRST, LAST])
def test_the_valid_jobs_are_done(finished_spool: SpoolFixture, name: str) -> None:
    assert finished_spool.status(name)["state"] == "done"
    assert (finished_spool.job(name).result / "metrics.json").is_file()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_broken_job_is_filed_under_failed_with_its_reason(finished_spool: SpoolFixture, case: Case) -> None:
    status = finished_spool.status(folder_of(case))
    code = IN_A_SPOOL.get(case.name, case.code)
    if code is None:
        assert status["state"] == "done"
        return
    assert status["state"] == "failed", status
    assert status["exit_code"] == code, status["error"]
    error = status["error"]
    assert MESSAGES_IN_A_SPOOL.get(case.name, case.message) in error["message"]
    assert Path(error["path"]).name == case.file
    assert error["hint"]
    assert status["stage"] in ("", "check")
    assert finished_spool.job(folder_of(case)).path.parent == finished_spool.spool.root / "failed"


def test_nothing_is_left_waiting_or_running(finished_spool: SpoolFixture) -> None:
    assert list(finished_spool.spool.inbox.iterdir()) == []
    assert list(finished_spool.spool.running.iterdir()) == []
