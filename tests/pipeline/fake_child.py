"""A child process with stages for tests: it computes, fails, crashes or never ends, as ordered."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError, EstimationError
from bodycap_batch.runner.child_main import main

Json = Mapping[str, Any]


def work(arguments: Json, context: StageContext, files: Path) -> None:
    for step in range(3):
        context.progress(step + 1, 3, "steps")
    loaded = [name for name in ("wave", "colorsys") if name in sys.modules]
    process = [context.threads, os.environ["OMP_NUM_THREADS"], os.getpid(), *loaded]
    (files / "process.txt").write_text(" ".join(map(str, process)))
    (files / "result.txt").write_text(f"{arguments['value']} {arguments.get('say', '')}")


def noisy(arguments: Json, context: StageContext, files: Path) -> None:
    os.write(1, b"a native library prints\n")
    print("so does Python")
    sys.stderr.write("and this is a log line\n")
    (files / "result.txt").write_text("done")


def refuse(arguments: Json, context: StageContext, files: Path) -> None:
    raise EstimationError("only 3 of 50 frames", path="video.mp4", hint="film more")


def bug(arguments: Json, context: StageContext, files: Path) -> None:
    {}["nothing"]


def crash(arguments: Json, context: StageContext, files: Path) -> None:
    ctypes.string_at(0)


def hang(arguments: Json, context: StageContext, files: Path) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    (context.work_dir / "started").write_text(str(os.getpid()))
    Path(arguments["started"]).write_text(f"{os.getpid()} {context.work_dir}")
    while True:
        time.sleep(0.05)


def polite(arguments: Json, context: StageContext, files: Path) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    Path(arguments["started"]).write_text(f"{os.getpid()} {context.work_dir}")
    while True:
        context.check_cancelled()
        time.sleep(0.02)


def fill(arguments: Json, context: StageContext, files: Path) -> None:
    with (files / "big.bin").open("wb") as stream:
        for _ in range(1000):
            stream.write(bytes(1 << 20))


def fill_quietly(arguments: Json, context: StageContext, files: Path) -> None:
    """Fill the disk and raise another error, as a library that hides the cause."""
    try:
        fill(arguments, context, files)
    except OSError:
        raise RuntimeError("cannot write database") from None


def fill_and_die(arguments: Json, context: StageContext, files: Path) -> None:
    try:
        fill(arguments, context, files)
    except OSError:
        os.abort()


def allocate(arguments: Json, context: StageContext, files: Path) -> None:
    """Use memory step by step, and hold it until the parent has seen it."""
    held = []
    for _ in range(int(arguments["mb"])):
        held.append(bytearray(b"x") * (1 << 20))
    time.sleep(0.6)
    (files / "result.txt").write_text(str(len(held)))


def allocate_at_once(arguments: Json, context: StageContext, files: Path) -> None:
    held = bytearray(int(arguments["mb"]) << 20)
    (files / "result.txt").write_text(str(len(held)))


def hide_memory_error(arguments: Json, context: StageContext, files: Path) -> None:
    try:
        raise MemoryError
    except MemoryError as error:
        raise CaptureError("cannot decode the video", path="torso.mp4", hint="copy it again") from error


def native_memory_error(arguments: Json, context: StageContext, files: Path) -> None:
    """End as a native thread does that cannot allocate memory."""
    os.write(2, b"terminate called after throwing an instance of 'std::bad_alloc'\n")
    os.abort()


def killed(arguments: Json, context: StageContext, files: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


TABLE = {
    function.__name__: function
    for function in (
        work,
        noisy,
        refuse,
        bug,
        crash,
        hang,
        polite,
        fill,
        fill_quietly,
        fill_and_die,
        allocate,
        allocate_at_once,
        hide_memory_error,
        native_memory_error,
        killed,
    )
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], TABLE))
