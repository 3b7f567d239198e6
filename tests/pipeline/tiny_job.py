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
from pathlib import Path
from typing import Any

from bodycap_batch.store.code_version import algorithm_version
from bodycap_batch.tasks.stages import STAGES as ALL_STAGES
from tests.pipeline.hurt_bodycap import ORDERS, PIDS, VERSIONS
from tests.processes import END_WITH_PARENT
from tests.results import results_of

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, str(Path(__file__).with_name("hurt_bodycap.py")))
JOB = """
capture:
  cameras:
    - {name: torso, video: capture/torso.mp4}
    - {name: left_palm, video: capture/left_palm.mp4}
  calibration: capture/calib.json
  synthetic: {seconds: 2, width: 320, height: 240, cameras: [torso, left_palm]}
height_m: 1.75
"""
STAGES = ("check", "keyframes", "map", "registration", "merge", "fill", "export")


class Place:
    """A job with an empty store, on a capture that is there already."""

    def __init__(self, folder: Path, capture: Path | None = None) -> None:
        self._name_folders(folder)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "tiny.yaml").write_text(JOB)
        (folder / "done.txt").touch()
        (folder / "pids").mkdir(exist_ok=True)
        versions = {
            stage.program.module: algorithm_version(stage.program.module) for stage in ALL_STAGES.values()
        }
        (folder / "versions.json").write_text(json.dumps(versions))
        if capture is not None:
            shutil.copytree(capture, folder / "capture", copy_function=os.link)
        self.order()

    def _name_folders(self, folder: Path) -> None:
        self.folder = folder
        self.out = folder / "out"
        self.store = folder / ".store"

    @classmethod
    def existing(cls, folder: Path) -> Place:
        """Return the job of a folder without a change to its files."""
        place = cls.__new__(cls)
        place._name_folders(folder)
        return place

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
            VERSIONS: str(self.folder / "versions.json"),
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
        """Results, and the digest of each artefact's content; not the report, which shows durations."""
        found = {name: data for name, data in results_of(self.out).items() if name != "report.html"}
        for path in self.manifests():
            if path.parts[-3] == "report":
                continue
            found[path.parent.relative_to(self.store).as_posix()] = json.loads(path.read_text())[
                "digest"
            ].encode()
        return found

    def remove_results(self) -> None:
        """Remove the results and the store."""
        for folder in (self.out, self.store):
            shutil.rmtree(folder)

    def manifests(self) -> list[Path]:
        """Of all artefacts but the rendered capture, which came from outside."""
        found = self.store.glob("artefacts/*/*/manifest.json")
        return sorted(path for path in found if path.parts[-3] != "synth")

    def leftovers(self) -> list[str]:
        """What only a crash leaves behind."""
        temporary = [path.name for path in (self.store / "tmp").iterdir() if not path.name.startswith("new-")]
        return [*temporary, *(path.name for path in self.out.rglob("*.part"))]


def same(mine: Place, reference: Place) -> None:
    found, expected = mine.content(), reference.content()
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []
    assert mine.leftovers() == []
