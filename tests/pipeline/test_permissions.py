"""What may not be read or written, tried without root's privileges: root can read and write anywhere."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.broken import BVH, edit

ROOT = Path(__file__).parents[2]
COMMAND = str(Path(__file__).with_name("fake_bodycap.py"))
_AS_ROOT = os.geteuid() == 0
WITHOUT_PRIVILEGES = ("setpriv", "--bounding-set=-all", "--inh-caps=-all") if _AS_ROOT else ()
"""Root without capabilities owns its files and is bound by their modes like anyone else."""
_NO_SETPRIV = _AS_ROOT and shutil.which("setpriv") is None
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(_NO_SETPRIV, reason="needs setpriv (util-linux) when run as root"),
]


@dataclass(frozen=True)
class Told:
    code: int
    text: str


def bodycap(folder: Path, *arguments: str, before: tuple[str, ...] = ()) -> Told:
    done = subprocess.run(
        [*before, *WITHOUT_PRIVILEGES, sys.executable, COMMAND, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return Told(done.returncode, done.stdout + done.stderr)


@pytest.fixture
def walk(sound_folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound_folder, tmp_path / "walk"))


def test_without_privileges_modes_count(walk: Path) -> None:
    """Else none of the tests below would mean anything."""
    (walk / "torso.mp4").chmod(0)
    done = subprocess.run([*WITHOUT_PRIVILEGES, "cat", walk / "torso.mp4"], capture_output=True, check=False)
    assert done.returncode != 0
    assert b"Permission denied" in done.stderr


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize(
    ("name", "code"), [("torso.mp4", 3), ("calib.json", 3), ("job.yaml", 2), ("subject.bvh", 2)]
)
def test_a_file_that_may_not_be_read_is_named_with_the_remedy(
    walk: Path, command: str, name: str, code: int
) -> None:
    (walk / "subject.bvh").write_text(BVH)
    edit("capture:", "skeleton: subject.bvh\ncapture:")(walk)
    (walk / name).chmod(0)
    told = bodycap(walk, command, "job.yaml")
    assert told.code == code, told.text
    assert name in told.text
    assert "ermission" in told.text
    assert "hint: " in told.text


@pytest.mark.parametrize(("locked", "code"), [("walk", 2), ("walk/card", 3)])
def test_a_folder_that_may_not_be_entered_is_named_with_the_remedy(
    walk: Path, locked: str, code: int
) -> None:
    (walk / "card").mkdir()
    (walk / "torso.mp4").rename(walk / "card" / "torso.mp4")
    edit("video: torso.mp4", "video: card/torso.mp4")(walk)
    (walk.parent / locked).chmod(0o600)
    told = bodycap(walk.parent, "check", "walk/job.yaml")
    (walk.parent / locked).chmod(0o700)
    assert told.code == code, told.text
    assert "ermission" in told.text
    assert "hint: " in told.text


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "job.yaml", "--out", "locked/results"),
        ("run", "job.yaml", "--out", "locked/results"),
        ("run", "job.yaml", "--store", "locked/store"),
    ],
    ids=" ".join,
)
def test_results_that_may_not_be_written_are_reported_before_anything_is_computed(
    walk: Path, arguments: tuple[str, ...]
) -> None:
    (walk / "locked").mkdir(mode=0o500)
    told = bodycap(walk, *arguments)
    assert told.code == 5, told.text
    assert "locked" in told.text
    assert "--out" in told.text
    assert "keyframes torso: done" not in told.text
    assert list((walk / "locked").iterdir()) == []


def test_a_read_only_disk_is_reported_with_the_remedy(walk: Path) -> None:
    mount = ("unshare", "--mount", "--propagation", "private", "sh", "-c")
    if subprocess.run([*mount, "true"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount in a mount namespace of its own (root)")
    (walk / "disk").mkdir()
    read_only = 'mount -t tmpfs -o ro none disk && exec "$@"'
    told = bodycap(walk, "run", "job.yaml", "--out", "disk/results", before=(*mount, read_only, "sh"))
    assert told.code == 5, told.text
    assert "disk/.store" in told.text
    assert "--out" in told.text


def test_an_earlier_result_that_may_not_be_changed_is_replaced_where_the_folder_may(walk: Path) -> None:
    """Results come by rename: what counts is the folder."""
    for name in ("torso.mp4", "head.mp4"):
        (walk / name).write_text("frames")  # the stand-in stages read text
    assert bodycap(walk, "run", "job.yaml", "--out", "results").code == 0
    (walk / "results" / "metrics.json").unlink()
    (walk / "results" / "metrics.json").write_text("earlier")
    (walk / "results" / "metrics.json").chmod(0o400)
    assert bodycap(walk, "run", "job.yaml", "--out", "results").code == 0
    assert (walk / "results" / "metrics.json").read_text() != "earlier"
    (walk / "results").chmod(0o500)
    (walk / "head.mp4").write_text("other frames")
    told = bodycap(walk, "run", "job.yaml", "--out", "results")
    (walk / "results").chmod(0o700)
    assert told.code == 5, told.text
    assert "hint: " in told.text


def test_a_folder_of_the_system_that_may_not_be_read_holds_no_job(tmp_path: Path, walk: Path) -> None:
    inbox = tmp_path / "jobs" / "inbox"
    inbox.mkdir(parents=True)
    (walk / ".Trash-1000").mkdir()
    (walk / ".Trash-1000").chmod(0)
    walk.rename(inbox / "walk")
    told = bodycap(tmp_path, "watch", "jobs", "--once", "--settle", "0")
    for path in tmp_path.rglob(".Trash-1000"):
        path.chmod(0o700)
    assert "cannot be read" not in told.text
    assert "walk: started" in told.text
    assert not list(inbox.iterdir())
