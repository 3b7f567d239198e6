"""Check whether this machine can run jobs, for `bodycap doctor`."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Literal

from bodycap_batch.core.context import cores
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.fbx import require_blender

State = Literal["ok", "note", "problem"]

_PYTHON_VERSIONS = ((3, 11), (3, 14))
"""First supported version of Python, and first later version that is not supported."""
_ENOUGH_MEMORY_MB = 4000
"""Memory (megabytes) that suffices for three cameras and ten minutes.

The map stage needs 2 to 3 GB for such a capture. Evidence: docs/decisions/check.md.
"""
_ENOUGH_DISK_MB = 5000
"""Free disk space (megabytes) that suffices for a usual job. Evidence: none."""
_LEAST_DISK_MB = 500
"""Free disk space (megabytes) with which jobs fail. Evidence: none."""
_LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy.optimize",
    "opencv-python-headless": "cv2",
    "av": "av",
    "open3d-cpu": "open3d",
    "pycolmap": "pycolmap",
    "gtsam": "gtsam",
    "pydantic": "pydantic",
}
_SYSTEM_PACKAGES = "apt-get install libegl1 libgl1 libx11-6 libusb-1.0-0"
_EXTRAS = {
    "formats": (("ezc3d", "pxr"), "C3D and USD files"),
    "cluster": (("distributed", "dask_jobqueue"), "many machines"),
    "web": (("starlette", "uvicorn"), "the live page of the watched folder"),
    "viewer": (("rerun",), "recordings for the Rerun viewer"),
}
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox", "microsoft-edge")
_CHILD_TIMEOUT_S = 60
"""Maximum time (seconds) for the import of one library.

The import of open3d takes some seconds on a slow disk. Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineFinding:
    """The result of one check of the machine.

    Attributes:
        what: Name of the checked part of the machine.
        state: "ok"; "note" if something is missing but jobs can run; "problem" if jobs will fail.
        found: Description of what was found.
        remedy: Advice to the user; "" if the user has to do nothing.
    """

    what: str
    state: State
    found: str
    remedy: str = ""

    def lines(self) -> list[str]:
        """Return the finding as text for the user."""
        text = f"{self.state:8} {self.what}: {self.found}"
        return [text, f"         -> {self.remedy}"] if self.remedy else [text]


def examine_machine(folder: Path) -> Iterator[MachineFinding]:
    """Check Python, processors, memory, libraries, disk, extras and programs, and yield each finding.

    Args:
        folder: Folder in which results will be written. It need not exist.
    """
    place = _nearest_existing(folder)
    yield _python_finding()
    yield _finding(
        "processors",
        f"{cores()}; no GPU is used" if cores() > 1 else "one",
        "" if cores() > 1 else "use a machine with two processors, if you can: jobs then run twice as fast",
    )
    yield _memory_finding()
    # Each import runs in a separate process. If a library crashes, this process continues.
    with ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1)) as pool:
        yield from pool.map(_library_finding, _LIBRARIES)
    yield _video_finding()
    yield _disk_finding(place)
    yield _writing_finding(place)
    for extra, (modules, purpose) in _EXTRAS.items():
        missing = [module for module in modules if util.find_spec(module) is None]
        yield _finding(
            f"extra [{extra}]",
            f"not installed: {', '.join(missing)}" if missing else purpose,
            f"if you need {purpose}, run: pip install 'bodycap-batch[{extra}]'" if missing else "",
        )
    yield _blender_finding()
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    yield _finding(
        "a browser",
        browser or "not found",
        ""
        if browser
        else "install Chromium or use any other browser to open report.html and to play preview.mp4",
    )


def _finding(what: str, found: str, remedy: str = "", *, is_problem: bool = False) -> MachineFinding:
    """Return a finding: what has no remedy is ok, otherwise it is a problem or a note."""
    state: State = "ok" if not remedy else "problem" if is_problem else "note"
    return MachineFinding(what=what, state=state, found=found, remedy=remedy)


def _python_finding() -> MachineFinding:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    supported = _PYTHON_VERSIONS[0] <= sys.version_info[:2] < _PYTHON_VERSIONS[1]
    return _finding("Python", found, "" if supported else "use Python 3.11, 3.12 or 3.13", is_problem=True)


def _memory_finding() -> MachineFinding:
    enough = f"{_ENOUGH_MEMORY_MB / 1000:g} GB"
    try:
        total_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 10**6
    except (ValueError, OSError, AttributeError):
        return _finding("memory", "unknown", f"jobs need {enough} of memory")
    remedy = (
        f"shorten long captures with start_s and end_s, or lower work_px: long captures need {enough}"
        if total_mb < _ENOUGH_MEMORY_MB
        else ""
    )
    return _finding("memory", f"{total_mb / 1000:.1f} GB", remedy)


def _library_finding(name: str) -> MachineFinding:
    failure = _error_of_code(f"import zlib, {_LIBRARIES[name]}")
    if failure is None:
        return _finding(name, _installed_version(name))
    remedy = "run make setup (or pip install -r requirements.lock)"
    if ".so" in failure:
        remedy = f"install the missing system library: {_SYSTEM_PACKAGES}"
    return _finding(name, failure, remedy, is_problem=True)


def _error_of_code(code: str) -> str | None:
    """Run Python code in a child process and return its error.

    Returns:
        The last line of the error output, or None if the code succeeds.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=_CHILD_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error).splitlines()[0]
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"ended with exit code {done.returncode}"


def _installed_version(name: str) -> str:
    for distribution in (name, name.removesuffix("-cpu"), name.removesuffix("-headless")):
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return "installed"


def _video_finding() -> MachineFinding:
    code = "import av; assert 'libx264' in av.codecs_available; av.Codec('h264', 'r'); av.Codec('hevc', 'r')"
    failure = _error_of_code(code)
    if failure is None:
        return _finding("video", "reads H.264 and H.265, writes H.264")
    remedy = "install PyAV from its wheel: pip install --force-reinstall av"
    return _finding("video", failure, remedy, is_problem=True)


def _disk_finding(place: Path) -> MachineFinding:
    free_mb = shutil.disk_usage(place).free // 10**6
    remedy = (
        "free some space (`bodycap gc` removes old artefacts), or choose another disk with --out and --store"
    )
    return _finding(
        "disk",
        f"{free_mb / 1000:.1f} GB free at {place}",
        remedy if free_mb < _ENOUGH_DISK_MB else "",
        is_problem=free_mb <= _LEAST_DISK_MB,
    )


def _writing_finding(place: Path) -> MachineFinding:
    """Check whether files can be written, renamed and hard-linked in a folder.

    These operations are used to publish results. If hard links are impossible, results are copied.
    """
    try:
        with tempfile.TemporaryDirectory(dir=place, prefix=".bodycap-doctor-") as scratch:
            first = Path(scratch) / "first"
            first.write_text("x")
            first.replace(Path(scratch) / "second")
            linked = _can_hard_link(Path(scratch) / "second", Path(scratch) / "third")
    except OSError as error:
        remedy = "choose a folder in which you may write (--out, --store)"
        return _finding("writing", f"{place}: {error.strerror}", remedy, is_problem=True)
    if linked:
        return _finding("writing", f"{place} supports files, renames and hard links")
    remedy = "no action needed: results are copied from the store and take twice the space"
    return _finding("writing", f"{place} has no hard links", remedy)


def _can_hard_link(source: Path, target: Path) -> bool:
    try:
        os.link(source, target)
    except OSError:
        return False
    return True


def _nearest_existing(folder: Path) -> Path:
    """Return the folder if it exists, or its nearest existing parent folder."""
    folder = folder.resolve()
    while not folder.exists():
        folder = folder.parent
    return folder


def _blender_finding() -> MachineFinding:
    """Look for Blender with the search of the exporter, and start it as the exporter does."""
    try:
        return _finding("Blender", f"{require_blender()} (writes FBX and .blend files)")
    except JobError as error:
        place = "" if error.path is None else f"{error.path}: "
        remedy = f"if you need FBX files (Maya, MotionBuilder, Unreal, Unity) or .blend files, {error.hint}"
        return _finding("Blender", place + error.message, remedy)
