"""A small real job that is killed, starved of disk and damaged: it always ends with the same bytes.

Everything is real: videos rendered by `synth`, all stages, child processes, files. What is compared are all
results and the content of every artefact, not the record of the run, its logs, or the resolved job.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.cli import main
from tests.pipeline.hurt_bodycap import BALLAST, ORDERS, PIDS
from tests.processes import END_WITH_PARENT
from tests.results import results_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, str(Path(__file__).with_name("hurt_bodycap.py")))
SEED = "BODYCAP_KILL_SEED"
RANDOM_KILLS = 20
JOB = """
capture:
  cameras:
    - {name: torso, video: capture/torso.mp4}
    - {name: left_palm, video: capture/left_palm.mp4}
  calibration: capture/calib.json
  synthetic: {seconds: 2, width: 320, height: 240, cameras: [torso, left_palm]}
height_m: 1.75
"""
STAGES = ("check", "keyframes", "map", "registration", "merge", "export")


class Place:
    """A job with an empty store, on a capture that is there already."""

    def __init__(self, folder: Path, capture: Path | None = None) -> None:
        self.folder = folder
        self.out = folder / "out"
        self.store = self.out / ".store"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "tiny.yaml").write_text(JOB)
        (folder / "done.txt").touch()
        (folder / "pids").mkdir(exist_ok=True)
        if capture is not None:
            shutil.copytree(capture, folder / "capture", copy_function=os.link)
        self.order()

    def order(self, **orders: Any) -> None:
        (self.folder / "orders.json").write_text(json.dumps(orders))

    def start(self) -> subprocess.Popen[str]:
        for path in (self.folder / "pids").iterdir():
            path.unlink()
        environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            ORDERS: str(self.folder / "orders.json"),
            PIDS: str(self.folder / "pids"),
        }
        environment.pop("BODYCAP_STORE", None)
        return subprocess.Popen(
            [*END_WITH_PARENT, *COMMAND, "run", "tiny.yaml", "--out", "out", "--json-progress"],
            cwd=self.folder,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def run(self) -> tuple[int, str, str]:
        process = self.start()
        out, err = process.communicate(timeout=300)
        return process.returncode, out, err

    def kill(self, process: subprocess.Popen[str]) -> None:
        """SIGKILL to the command's process group and to those of its children."""
        process.send_signal(signal.SIGSTOP)  # so that it starts no child meanwhile
        groups = {int(path.name) for path in (self.folder / "pids").iterdir()} | {process.pid}
        for group in groups:
            try:
                os.killpg(group, signal.SIGKILL)
            except ProcessLookupError:
                continue
        process.communicate()

    def content(self) -> dict[str, bytes]:
        """Results, and the digest of what each artefact holds; the report tells of durations."""
        found = {name: data for name, data in results_of(self.out).items() if name != "report.html"}
        for path in self.manifests():
            if path.parts[-3] == "report":
                continue
            found[path.parent.relative_to(self.store).as_posix()] = json.loads(path.read_text())[
                "digest"
            ].encode()
        return found

    def manifests(self) -> list[Path]:
        """Of all artefacts but the rendered capture, which came from outside."""
        return sorted(self.store.glob("artefacts/[!s]*/*/manifest.json"))

    def leftovers(self) -> list[str]:
        """What only a crash leaves behind."""
        temporary = [path.name for path in (self.store / "tmp").iterdir() if not path.name.startswith("new-")]
        return [*temporary, *(path.name for path in self.out.rglob("*.part"))]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The job has been run, uninterrupted."""
    place = Place(tmp_path_factory.mktemp("reference"))
    assert main(["run", str(place.folder / "tiny.yaml"), "--out", str(place.out)]) == 0
    names = set(place.content())
    assert {"motion.bvh", "frames.csv", "metrics.json", "trajectories/torso.tum"} <= names
    assert {name.split("/")[1] for name in names if name.startswith("artefacts/")} >= set(STAGES)
    return place


@pytest.fixture
def place(tmp_path: Path, reference: Place) -> Place:
    return Place(tmp_path / "job", reference.folder / "capture")


def same(mine: Place, reference: Place) -> None:
    found, expected = mine.content(), reference.content()
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []
    assert mine.leftovers() == []


def killed_at(place: Place, when: str, what: str = "") -> list[str]:
    """Run until it is killed at no renaming any more; returns those it was killed at, one a run."""
    place.order(kill=when, at=what, done=str(place.folder / "done.txt"))
    kills = 0
    while (end := place.run())[0] == -signal.SIGKILL:
        kills += 1
        assert kills < 150, "no progress"
    assert end[0] == 0, end[2]
    points = (place.folder / "done.txt").read_text().splitlines()
    assert len(points) == kills
    return points


def test_killed_before_every_renaming_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    points = killed_at(place, "before")
    committed = [line for line in points if "/artefacts/" in line]
    assert len(committed) == len(place.manifests()) >= 8
    assert sum(line.endswith("/files/manifest.json") for line in points) >= len(STAGES)
    published = {Path(line).relative_to(place.out).as_posix() for line in points if ".store" not in line}
    assert published >= {"motion.bvh", "frames.csv", "metrics.json", "run.json", "trajectories/torso.tum"}
    same(place, reference)


def test_killed_after_every_commit_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    """After a renaming that is no commit nothing is different until just before the next one."""
    assert len(killed_at(place, "after", "/artefacts/")) == len(place.manifests()) >= 8
    same(place, reference)


def test_killed_at_random_moments_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    seed = int(os.environ.get(SEED) or np.random.SeedSequence().generate_state(1)[0])
    print(f"{SEED}={seed}")
    rng = np.random.default_rng(seed)
    begun = time.monotonic()
    assert place.run()[0] == 0
    whole_s = time.monotonic() - begun
    same(place, reference)
    kills = completed = 0
    shutil.rmtree(place.out)
    while kills < RANDOM_KILLS:
        process = place.start()
        try:
            process.communicate(timeout=rng.uniform(0.0, whole_s))
        except subprocess.TimeoutExpired:
            place.kill(process)
            kills += 1
            continue
        assert process.returncode == 0
        completed += 1
        same(place, reference)
        shutil.rmtree(place.out)
    code, _, err = place.run()
    assert code == 0, err
    same(place, reference)
    print(f"{kills} kills within {whole_s:.1f} s each, {completed} runs completed between them")


@pytest.mark.parametrize("which", ["manifest", "largest", "smallest"])
def test_a_flipped_byte_in_every_artefact_is_found_and_what_it_was_in_rebuilt(
    place: Place, reference: Place, which: str
) -> None:
    shutil.copytree(reference.out, place.out)
    damaged = place.manifests()
    assert {path.parts[-3] for path in damaged} >= set(STAGES)
    for path in damaged:
        flip(path.parent, which)
    code, _, err = place.run()
    assert code == 0, err
    assert len(list((place.store / "corrupt").iterdir())) == len(damaged)
    same(place, reference)


def flip(folder: Path, which: str) -> None:
    """Change one bit in the middle of an artefact's file."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json"]
    by_size = sorted((path for path in files if path.stat().st_size), key=lambda path: path.stat().st_size)
    victim = {"manifest": folder / "manifest.json", "largest": by_size[-1], "smallest": by_size[0]}[which]
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)


_ON_A_SMALL_DISK = """
import sys
from pathlib import Path
from tests.pipeline.test_resume_proof import full_disk
full_disk(Path(sys.argv[1]), Path(sys.argv[2]))
"""


def test_a_disk_that_fills_up_in_any_stage_loses_nothing(tmp_path: Path, reference: Place) -> None:
    mount = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    if subprocess.run([*mount, "mount -t tmpfs none /mnt"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs in a mount namespace of its own (root)")
    command = 'mount -t tmpfs -o size=300m none "$1" && exec "$2" -c "$3" "$1" "$4"'
    done = subprocess.run(
        [*mount, command, "sh", str(tmp_path), sys.executable, _ON_A_SMALL_DISK, str(reference.folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def full_disk(disk: Path, reference: Path) -> None:
    """Run the job on a disk that is filled to the last byte in each stage, one after another."""
    place = Place(disk / "job")
    shutil.copytree(reference / "capture", place.folder / "capture")
    for stage in STAGES:
        place.order(fill=stage, disk=str(disk))
        code, out, err = place.run()
        assert (disk / BALLAST).exists(), f"{stage} did not run: {err}"
        last = json.loads(out.splitlines()[-1])
        assert (code, last["type"]) == (5, "StoreError"), (stage, code, err)
        assert "No space left" in last["message"], (stage, last)
        assert "--store" in last["hint"], (stage, last)
        (disk / BALLAST).unlink()
        assert not any(f"/artefacts/{stage}/" in str(path) for path in place.manifests()), stage
    place.order()
    code, _, err = place.run()
    assert code == 0, err
    wanted = Place.__new__(Place)
    wanted.folder, wanted.out, wanted.store = reference, reference / "out", reference / "out" / ".store"
    same(place, wanted)
