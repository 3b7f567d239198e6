"""Each module alone in a fresh interpreter: import order must not matter, and a start must stay cheap."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "bodycap_batch"

# Loaded before zlib, pycolmap makes every later compression abort: so whatever a module brings in, and
# whatever comes after it, files must still be written and read back.
AFTER_IMPORT = """
import importlib, sys
importlib.import_module(sys.argv[1])
import pycolmap
from pathlib import Path
import cv2, numpy
image = numpy.arange(120 * 160 * 3, dtype=numpy.uint32).astype(numpy.uint8).reshape(120, 160, 3)
folder = Path(sys.argv[2])
assert cv2.imwrite(str(folder / "image.png"), image)
assert (cv2.imread(str(folder / "image.png")) == image).all()
numpy.savez_compressed(folder / "arrays.npz", image=image)
assert (numpy.load(folder / "arrays.npz")["image"] == image).all()
"""
# Python imports the packages of a module before the module. So a package is imported once, and copies of this
# process import the modules in it, one each; a module that its package brings in has been reached like that.
# The libraries, and the job's models, are loaded once; what is loaded is not looked through for garbage.
ALONE = """
import concurrent.futures.thread, filecmp, gc, html, http.server, importlib, os, queue, shlex, sys, traceback
import webbrowser, zlib
import numpy, pydantic, scipy.spatial.transform, scipy.optimize, scipy.sparse, scipy.linalg, typer, yaml
import cv2, gtsam
import bodycap_batch.config.models
gc.disable()
def reach(name):
    importlib.import_module(name)
    inside = [each for each in sys.argv[1:] if each.rpartition(".")[0] == name]
    return all([reach(each) if each in sys.modules else reach_in_copy(each) for each in inside])
def reach_in_copy(name):
    if pid := os.fork():
        if failed := os.waitpid(pid, 0)[1]:
            print(name, flush=True)
        return not failed
    try:
        os._exit(0 if reach(name) else 1)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
reach("bodycap_batch")
"""
# What costs tenths of seconds to seconds to load, or changes the process (pycolmap takes over SIGTERM).
HEAVY = ("pycolmap", "open3d", "gtsam", "cv2", "av", "matplotlib", "pandas", "distributed", "pytest")


def module_names() -> list[str]:
    """All importable modules; ``__main__`` acts when imported and is left to its own tests."""
    paths = [path.relative_to(REPOSITORY).with_suffix("") for path in sorted(PACKAGE.rglob("*.py"))]
    dotted = (".".join(path.parts).removesuffix(".__init__") for path in paths)
    return [name for name in dotted if not name.endswith("__main__")]


def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(
        [sys.executable, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def modules_after(name: str) -> set[str]:
    done = run_python("-c", f"import json, sys, {name}; print(json.dumps(list(sys.modules)))")
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


def failures(names: list[str], folder: Path) -> str:
    """Import each module in an interpreter of its own, as many at a time as there are cores."""

    def failure(name: str) -> str:
        (folder / name).mkdir()
        done = run_python("-c", AFTER_IMPORT, name, str(folder / name))
        return f"{name}: exit code {done.returncode}\n{done.stderr}" if done.returncode else ""

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return "\n".join(filter(None, pool.map(failure, names)))


@pytest.mark.slow
def test_each_module_can_be_the_first_one() -> None:
    """No circle of imports, wherever one enters it: each in a copy of an interpreter with the libraries."""
    names = module_names()
    assert {"bodycap_batch.model.geometry", "bodycap_batch.config.options"} <= set(names)
    done = run_python("-c", ALONE, *names)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


def test_the_package_alone_leaves_compression_working(tmp_path: Path) -> None:
    """Each module begins with the package's own `__init__`, so zlib comes first whichever it is."""
    assert not failures(["bodycap_batch", "bodycap_batch.mapping", "bodycap_batch.cli"], tmp_path)


@pytest.mark.slow
def test_each_room_alone_leaves_compression_working(tmp_path: Path) -> None:
    rooms = [name for name in module_names() if name.count(".") <= 1]
    assert "bodycap_batch.keyframes" in rooms
    assert not failures(rooms, tmp_path)


def test_heavy_libraries_load_when_needed() -> None:
    assert not modules_after("bodycap_batch.pipeline") & {*HEAVY, "scipy"}
    assert not modules_after("bodycap_batch.cli") & {*HEAVY, "scipy"}


@pytest.mark.parametrize(
    ("loaded", "unneeded"),
    [
        ("bodycap_batch.clocks", "scipy.signal"),
        ("bodycap_batch.mapping", "scipy"),
        ("bodycap_batch.report.criteria", "scipy"),
    ],
)
def test_parts_of_scipy_load_when_needed(loaded: str, unneeded: str) -> None:
    assert unneeded not in modules_after(loaded)


def test_help_answers() -> None:
    done = run_python("-c", "from bodycap_batch.cli import main; main()", "--help")
    assert done.returncode == 0, done.stderr
    for command in ("run", "check", "evaluate", "synth"):
        assert command in done.stdout
