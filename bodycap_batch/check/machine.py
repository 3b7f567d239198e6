"""Check whether this machine can run jobs, for `bodycap doctor`."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
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
    yield _python_finding()
    yield _processor_finding()
    yield _memory_finding()
    # Each import runs in a separate process. If a library crashes, this process continues.
    with ThreadPoolExecutor(max_workers=max(1, os.cpu_count() or 1)) as pool:
        yield from pool.map(_library_finding, _LIBRARIES)
    yield _video_finding()
    yield _disk_finding(folder)
    yield _writing_finding(folder)
    for extra in _EXTRAS:
        yield _extra_finding(extra)
    yield _blender_finding()
    yield _program_finding(
        "a browser",
        _BROWSERS,
        "install Chromium or use any other browser to open report.html and to play preview.mp4",
    )


def _python_finding() -> MachineFinding:
    version = sys.version_info[:2]
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    if _PYTHON_VERSIONS[0] <= version < _PYTHON_VERSIONS[1]:
        return MachineFinding(what="Python", state="ok", found=found)
    return MachineFinding(what="Python", state="problem", found=found, remedy="use Python 3.11, 3.12 or 3.13")


def _processor_finding() -> MachineFinding:
    count = cores()
    if count > 1:
        return MachineFinding(what="processors", state="ok", found=f"{count}; no GPU is used")
    return MachineFinding(
        what="processors",
        state="note",
        found="one",
        remedy="use a machine with two processors, if you can: jobs then run twice as fast",
    )


def _memory_finding() -> MachineFinding:
    total_mb = _total_memory_mb()
    if total_mb is None:
        return MachineFinding(
            what="memory",
            state="note",
            found="unknown",
            remedy=f"jobs need {_ENOUGH_MEMORY_MB / 1000:g} GB of memory",
        )
    found = f"{total_mb / 1000:.1f} GB"
    if total_mb >= _ENOUGH_MEMORY_MB:
        return MachineFinding(what="memory", state="ok", found=found)
    remedy = (
        "shorten long captures with start_s and end_s, or lower work_px: long captures need "
        f"{_ENOUGH_MEMORY_MB / 1000:g} GB"
    )
    return MachineFinding(what="memory", state="note", found=found, remedy=remedy)


def _total_memory_mb() -> int | None:
    """Return the memory of this machine in megabytes (1 MB = 10⁶ bytes); None if it is unknown."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 10**6
    except (ValueError, OSError, AttributeError):
        return None


def _library_finding(name: str) -> MachineFinding:
    failure = _error_of_code(f"import zlib, {_LIBRARIES[name]}")
    if failure is None:
        return MachineFinding(what=name, state="ok", found=_installed_version(name))
    remedy = "run make setup (or pip install -r requirements.lock)"
    if ".so" in failure:
        remedy = f"install the missing system library: {_SYSTEM_PACKAGES}"
    return MachineFinding(what=name, state="problem", found=failure, remedy=remedy)


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
        return MachineFinding(what="video", state="ok", found="reads H.264 and H.265, writes H.264")
    remedy = "install PyAV from its wheel: pip install --force-reinstall av"
    return MachineFinding(what="video", state="problem", found=failure, remedy=remedy)


def _disk_finding(folder: Path) -> MachineFinding:
    place = _nearest_existing(folder)
    free_mb = shutil.disk_usage(place).free // 10**6
    found = f"{free_mb / 1000:.1f} GB free at {place}"
    if free_mb >= _ENOUGH_DISK_MB:
        return MachineFinding(what="disk", state="ok", found=found)
    remedy = (
        "free some space (`bodycap gc` removes old artefacts), or choose another disk with --out and --store"
    )
    return MachineFinding(
        what="disk", state="note" if free_mb > 500 else "problem", found=found, remedy=remedy
    )


def _writing_finding(folder: Path) -> MachineFinding:
    """Check whether files can be written, renamed and hard-linked in a folder.

    These operations are used to publish results. If hard links are impossible, results are copied.
    """
    place = _nearest_existing(folder)
    try:
        with tempfile.TemporaryDirectory(dir=place, prefix=".bodycap-doctor-") as scratch:
            first = Path(scratch) / "first"
            first.write_text("x")
            first.replace(Path(scratch) / "second")
            linked = _can_hard_link(Path(scratch) / "second", Path(scratch) / "third")
    except OSError as error:
        remedy = "choose a folder in which you may write (--out, --store)"
        return MachineFinding(
            what="writing", state="problem", found=f"{place}: {error.strerror}", remedy=remedy
        )
    if linked:
        return MachineFinding(
            what="writing", state="ok", found=f"{place} supports files, renames and hard links"
        )
    remedy = "no action needed: results are copied from the store and take twice the space"
    return MachineFinding(what="writing", state="note", found=f"{place} has no hard links", remedy=remedy)


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


def _extra_finding(name: str) -> MachineFinding:
    modules, purpose = _EXTRAS[name]
    missing = [module for module in modules if util.find_spec(module) is None]
    if not missing:
        return MachineFinding(what=f"extra [{name}]", state="ok", found=purpose)
    remedy = f"if you need {purpose}, run: pip install 'bodycap-batch[{name}]'"
    return MachineFinding(
        what=f"extra [{name}]", state="note", found=f"not installed: {', '.join(missing)}", remedy=remedy
    )


def _blender_finding() -> MachineFinding:
    """Look for Blender with the search of the exporter, and start it as the exporter does."""
    try:
        found = f"{require_blender()} (writes FBX and .blend files)"
        return MachineFinding(what="Blender", state="ok", found=found)
    except JobError as error:
        place = "" if error.path is None else f"{error.path}: "
        remedy = f"if you need FBX files (Maya, MotionBuilder, Unreal, Unity) or .blend files, {error.hint}"
        return MachineFinding(what="Blender", state="note", found=place + error.message, remedy=remedy)


def _program_finding(what: str, names: Sequence[str], purpose: str) -> MachineFinding:
    found = next((place for name in names if (place := shutil.which(name))), None)
    if found:
        return MachineFinding(what=what, state="ok", found=found)
    return MachineFinding(what=what, state="note", found="not found", remedy=purpose)
