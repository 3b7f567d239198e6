"""The commands that the pages show, and a place with real stored results where a user would type them."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.boards import PINHOLE_LENS, board_clip, chessboard_picture, with_margin
from tests.gpmf import Sensor, payloads, write_gopro
from tests.pipeline.tiny_job import JOB, Place
from tests.processes import END_WITH_PARENT
from tests.sounds import heard, scene, write_video_with_sound
from tests.videos import textured_frame, write_video

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs" / "tutorials").glob("*.md")))
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`(bodycap [a-z]+ [^`]+)`")
"""A command in a sentence; a name without arguments is none."""


def commands_in(page: Path) -> Iterator[str]:
    """Yield each command that a page shows, with single spaces and without its comment."""
    text = page.read_text(encoding="utf-8")
    blocks = _BLOCK.findall(text)
    lines = [line for block in blocks for line in block.splitlines()]
    rest = _BLOCK.sub("", text)
    for line in (*lines, *_INLINE.findall(rest)):
        words = shlex.split(line, comments=True)
        if words:
            yield " ".join(words)


OFFSETS_S = {"torso": 0.0, "left_palm": 0.35}
"""Offset of the clock of each camera in the folder with sound, seconds."""


@dataclass(frozen=True)
class Done:
    """A command that has ended.

    Attributes:
        code: Its exit code.
        out: What it printed on standard output.
        err: What it printed on standard error.
        written: The files that are new or changed, relative to the folder of the site, without the store.
    """

    code: int
    out: str
    err: str
    written: set[str]


@dataclass
class Site:
    """A folder with videos and with the results of a real job; the stages of the job are stored.

    Attributes:
        folder: The working folder.
        opened: File to which the browser writes the address that it is given.
    """

    folder: Path
    opened: Path = field(init=False)

    def __post_init__(self) -> None:
        self.opened = self.folder / "opened.txt"

    @property
    def environment(self) -> dict[str, str]:
        """The environment of the commands; a blender of the user is found, as the program finds it."""
        kept = {name: value for name, value in os.environ.items() if name != "BODYCAP_STORE"}
        return {
            **kept,
            "PYTHONPATH": str(ROOT),
            "BODYCAP_STORE": str(self.folder / "stored"),
            "BROWSER": f"sh -c 'echo %s >{self.opened}'",
        }

    def start(self, words: Sequence[str], place: str = ".") -> subprocess.Popen[str]:
        """Start the command in a process of its own, in a folder of the site."""
        main = "import sys; from bodycap_batch.cli import main; sys.exit(main())"
        command = [*END_WITH_PARENT, sys.executable, "-c", main, *words[1:]]
        return subprocess.Popen(
            command,
            cwd=self.folder / place,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def run(self, command: str, *more: str, place: str = ".") -> Done:
        """Run a command of a page to its end.

        Args:
            command: The command.
            more: Further words.
            place: The working folder, relative to the folder of the site.
        """
        before = self.files()
        process = self.start([*shlex.split(command), *more], place)
        out, err = process.communicate(timeout=600)
        assert "Traceback" not in err, err
        after = self.files()
        written = {name for name, state in after.items() if before.get(name) != state}
        return Done(process.returncode, out, err, written)

    def files(self) -> dict[str, tuple[int, int]]:
        """Return inode and time of change of each file outside the store."""
        found = {}
        for path in self.folder.rglob("*"):
            name = path.relative_to(self.folder).as_posix()
            if path.is_file() and not name.startswith("stored/"):
                state = path.stat()
                found[name] = (state.st_ino, state.st_mtime_ns)
        return found


def make_site(folder: Path, reference: Place) -> Site:
    """Copy the videos and the store of a job that has been run, and make the files that the pages name."""
    site = Site(folder)
    shutil.copytree(reference.store, folder / "stored")  # a linked lock would be that of the other store
    shutil.copytree(reference.folder / "capture", folder / "capture", copy_function=os.link)
    (folder / "my_walk").mkdir()
    for name in ("torso.mp4", "left_palm.mp4", "calib.json"):
        shutil.copy(folder / "capture" / name, folder / "my_walk" / name)
    (folder / "cpl_lab.yaml").write_text(JOB)
    shutil.copytree(folder / "capture" / "gt", folder / "examples" / "cpl_lab" / "gt")
    for name in ("mocap.bvh", "walk.bvh"):
        shutil.copy(folder / "capture" / "gt" / "motion.bvh", folder / name)
    board = board_clip(
        PINHOLE_LENS, with_margin(chessboard_picture(9, 6)), 16, np.random.default_rng(1), whole=True
    )
    write_video(folder / "board.mp4", board, fps=5)
    with_sound, source = folder / "with_sound" / "my_walk", scene(3, 8.0)
    with_sound.mkdir(parents=True)
    for seed, (name, offset_s) in enumerate(OFFSETS_S.items()):
        write_video_with_sound(with_sound / f"{name}.mp4", heard(source, seed, 8.0, offset_s))
    frames = [textured_frame(index % 30) for index in range(60)]
    write_gopro(folder / "GX010123.MP4", frames, payloads(Sensor(), 2))
    return site
