"""A small real job whose artefacts are damaged and whose disk fills up: it ends with the same bytes."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pipeline.hurt_bodycap import BALLAST
from tests.pipeline.tiny_job import ROOT, STAGES, Place, same

pytestmark = pytest.mark.slow


def test_a_flipped_byte_in_every_artefact_is_found_and_what_it_was_in_rebuilt(
    place: Place, reference: Place
) -> None:
    shutil.copytree(reference.out, place.out)
    shutil.copytree(reference.store, place.store)
    damaged = place.manifests()
    assert {path.parts[-3] for path in damaged} >= set(STAGES)
    for path, which in zip(damaged, itertools.cycle(("manifest", "largest", "smallest"))):
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
from tests.pipeline.test_damage_proof import full_disk
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
    for stage in (*STAGES, "report"):
        place.order(fill=stage, disk=str(disk))
        code, out, err = place.run()
        assert (disk / BALLAST).exists(), f"{stage} did not run: {err}"
        last = json.loads(out.splitlines()[-1])
        assert (code, last["type"]) == (5, "StoreError"), (stage, code, err)
        # A stage has several tasks: one fails while it writes, or one that has not started is refused.
        assert re.search("No space left|MB of free space, but the job needs", last["message"]), (stage, last)
        assert "--store" in last["hint"], (stage, last)
        (disk / BALLAST).unlink()
        assert not any(f"/artefacts/{stage}/" in str(path) for path in place.manifests()), stage
    place.order()
    code, _, err = place.run()
    assert code == 0, err
    same(place, Place.existing(reference))
