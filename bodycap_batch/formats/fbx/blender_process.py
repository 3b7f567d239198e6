"""Find Blender and run a script in Blender."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from bodycap_batch.core.errors import JobError, StoreError

BLENDER_VARIABLE = "BODYCAP_BLENDER"
"""Name of the environment variable for the path of Blender, or of a Python that has the module ``bpy``."""

_HINT = (
    f"install Blender as a Python module with `make blender` (Python 3.11), or set {BLENDER_VARIABLE} to a "
    "Python that has the module bpy or to a blender executable (4.2 or later)"
)
_TIMEOUT_S = 3600.0
"""Maximum duration of a run of Blender, seconds. Evidence: none; it only ends a process that hangs."""

_START_TEST = (
    "import bpy, sys; bpy.app.version < (4, 2) and sys.exit(f'{bpy.app.version_string} is older than 4.2')"
)
"""Python statement that fails if Blender does not start, or is too old for the scripts."""


def find_blender() -> Path:
    """Return the path of a Python that has the module ``bpy``, or of a Blender executable.

    The search order is: ``BODYCAP_BLENDER``, the running Python, ``.venv-blender`` in the working folder,
    ``.venv-blender`` in the folder that contains this package, and ``blender`` on the search path (``PATH``).

    Raises:
        JobError: Blender was not found, or the value of ``BODYCAP_BLENDER`` is not a program.
    """
    named = os.environ.get(BLENDER_VARIABLE)
    if named:
        if not os.access(named, os.X_OK) or Path(named).is_dir():
            raise JobError(f"{BLENDER_VARIABLE} is not the path of a program", path=named, hint=_HINT)
        return Path(named)
    if importlib.util.find_spec("bpy") is not None:
        return Path(sys.executable)
    package_parent = Path(__file__).resolve().parents[3]
    for folder in (Path.cwd(), package_parent):
        python = folder / ".venv-blender" / "bin" / "python"
        if python.is_file():
            return python
    if (installed := shutil.which("blender")) is not None:
        return Path(installed)
    raise JobError(
        "FBX and .blend files need Blender, which was not found", field="export.formats", hint=_HINT
    )


def require_blender() -> Path:
    """Check that Blender is installed and starts, and return its path.

    Raises:
        JobError: Blender was not found, does not start or is older than 4.2.
    """
    blender = find_blender()
    script = ["--python-expr", _START_TEST] if is_blender_executable(blender) else ["-c", _START_TEST]
    done = _run([str(blender), *_flags(blender), *script])
    if done.returncode != 0:
        raise JobError(f"Blender cannot be used: {_last_line(done)}", path=blender, hint=_HINT)
    return blender


def run_script(script: Path, arguments: Sequence[str], *, made: Path, path: Path) -> None:
    """Run a Python file in Blender, which writes a file.

    Python's hash seed is constant, so that every run writes the same bytes.

    Args:
        script: Path of the Python file.
        arguments: Command-line arguments of the Python file.
        made: Path of the file that the script must write.
        path: Path of the result, for the error.

    Raises:
        JobError: Blender was not found.
        StoreError: The script failed, or did not write its file.
    """
    blender = find_blender()
    call = ["--python", str(script), "--"] if is_blender_executable(blender) else [str(script)]
    done = _run([str(blender), *_flags(blender), *call, *arguments])
    if done.returncode != 0 or not made.is_file():
        raise StoreError(
            f"Blender could not write the file: {_last_line(done)}",
            path=path,
            hint="check the disk for errors",
        )


def _last_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return the last line of the errors of a finished process; its exit code without errors."""
    return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


def is_blender_executable(blender: Path) -> bool:
    """Return True if a program is Blender, and False if it is a Python with the module ``bpy``."""
    return blender.name.lower().startswith("blender")


def _flags(blender: Path) -> list[str]:
    """Return the command-line options that start Blender without a window and without user settings."""
    if is_blender_executable(blender):
        return ["--background", "--factory-startup", "--python-exit-code", "1"]
    return ["-P"]


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command without the environment variables whose names start with ``PYTHON``.

    These variables of the running process could break Blender's Python.
    """
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    environment = {**kept, "PYTHONHASHSEED": "0"}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=_TIMEOUT_S
    )
