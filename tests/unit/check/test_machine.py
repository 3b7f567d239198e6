"""`bodycap doctor`: each missing part is reported with a remedy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.check import machine
from bodycap_batch.check.machine import MachineFinding, examine_machine
from bodycap_batch.cli import main
from bodycap_batch.formats.fbx import blender_process, find_blender


def finding(name: str, folder: Path) -> MachineFinding:
    return next(each for each in examine_machine(folder) if each.what == name)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Test one small library instead of all: open3d alone takes seconds."""
    monkeypatch.setattr(machine, "_LIBRARIES", {"numpy": "numpy"})
    monkeypatch.setattr(
        machine, "_video_finding", lambda: MachineFinding(what="video", state="ok", found="as ever")
    )


def test_a_machine_without_problems_can_run_jobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--out", str(tmp_path / "not" / "there")]) == 0
    output = capsys.readouterr().out
    assert output.splitlines()[-1] == "this machine can run jobs"
    assert "numpy" in output
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


def test_a_library_that_does_not_load_is_a_problem_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        machine, "_LIBRARIES", {"numpy": "numpy", "gone": "no_such_module", "sick": "os; os.abort()"}
    )
    assert main(["doctor", "--out", str(tmp_path), "--json"]) == 5
    findings = {each["what"]: each for each in json.loads(capsys.readouterr().out)}
    assert findings["numpy"]["state"] == "ok"
    for name in ("gone", "sick"):
        assert findings[name]["state"] == "problem"
        assert "requirements.lock" in findings[name]["remedy"]
    assert "no_such_module" in findings["gone"]["found"]


def test_a_missing_system_library_names_the_packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    error = "ImportError: libGL.so.1: cannot open shared object file"
    monkeypatch.setattr(machine, "_error_of_code", lambda code: error)
    assert "apt-get install" in finding("numpy", tmp_path).remedy


def test_a_full_disk_and_an_unwritable_folder_are_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = machine.shutil._ntuple_diskusage(100, 100, 100 << 20)  # type: ignore[attr-defined]
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda place: usage)
    disk = finding("disk", tmp_path)
    assert disk.state == "problem"
    assert "--store" in disk.remedy
    (tmp_path / "file").write_text("")
    assert finding("writing", tmp_path / "file").state == "problem"


def test_without_hard_links_results_are_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_can_hard_link", lambda source, target: False)
    writing = finding("writing", tmp_path)
    assert writing.state == "note"
    assert "copied" in writing.remedy


def test_a_missing_extra_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_EXTRAS", {"formats": (("no_such_module",), "C3D and USD files")})
    extra = finding("extra [formats]", tmp_path)
    assert extra.state == "note"
    assert "[formats]" in extra.remedy


def test_memory_and_disk_are_compared_in_megabytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pages = {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 4_100_000_000 // 4096}
    monkeypatch.setattr(machine.os, "sysconf", pages.__getitem__)
    assert (finding("memory", tmp_path).state, finding("memory", tmp_path).found) == ("ok", "4.1 GB")
    pages["SC_PHYS_PAGES"] = 3_900_000_000 // 4096
    assert finding("memory", tmp_path).state == "note"
    usage = machine.shutil._ntuple_diskusage(0, 0, 5_100_000_000)  # type: ignore[attr-defined]
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: usage)
    assert finding("disk", tmp_path).state == "ok"
    assert "5.1 GB free" in finding("disk", tmp_path).found


def program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_blender_is_where_the_exporter_finds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BODYCAP_BLENDER", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(blender_process, "__file__", str(tmp_path / "a" / "b" / "c" / "blender.py"))
    monkeypatch.setenv("PATH", str(tmp_path / "programs"))
    missing = finding("Blender", tmp_path)
    assert missing.state == "note"
    assert "not found" in missing.found
    assert "FBX" in missing.remedy
    assert "make blender" in missing.remedy
    places = [tmp_path / "programs" / "blender", tmp_path / ".venv-blender" / "bin" / "python"]
    for place in places:
        program(place, "exit 0")
        assert (finding("Blender", tmp_path).state, find_blender()) == ("ok", place)
        assert str(place) in finding("Blender", tmp_path).found
    monkeypatch.setenv(
        "BODYCAP_BLENDER", str(program(tmp_path / "old" / "blender", "echo 3.4 is old >&2; exit 1"))
    )
    assert finding("Blender", tmp_path).state == "note"
    assert "3.4 is old" in finding("Blender", tmp_path).found
