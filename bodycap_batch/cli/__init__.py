"""The entry point of the `bodycap` command. Errors are converted to messages and exit codes."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from bodycap_batch.cli import (
    batch,
    calibrate,
    check,
    doctor,
    evaluate,
    init,
    report,
    run,
    skeleton,
    spool,
    sync,
    synth,
    view,
    watch,
    why,
)
from bodycap_batch.cli.application import app
from bodycap_batch.cli.signals import raise_on_signal, signal_exit_code
from bodycap_batch.core.errors import EXIT_BUG, BodycapError, Cancelled, DiskAway

__all__ = [
    "batch",
    "calibrate",
    "check",
    "doctor",
    "evaluate",
    "init",
    "main",
    "report",
    "run",
    "skeleton",
    "spool",
    "sync",
    "synth",
    "view",
    "watch",
    "why",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line.

    Args:
        arguments: The words after ``bodycap``; None for the command line of this process.

    Returns:
        The exit code. If `arguments` is None, the function does not return: the process exits with this exit
        code.
    """
    with raise_on_signal():
        code = _run(sys.argv[1:] if arguments is None else list(arguments))
    if arguments is None:
        sys.exit(code)
    return code


def _run(arguments: Sequence[str]) -> int:
    try:
        app(list(arguments), prog_name="bodycap")
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else 0
    except Cancelled as error:
        _write_error(str(error))
        return signal_exit_code()
    except BodycapError as error:
        _write_error(f"error: {error}")
        for note in getattr(error, "__notes__", []):
            _write_error(note)
        return error.exit_code
    except Exception as error:  # noqa: BLE001 - the only place where bugs are caught
        if (disk_error := _disk_error(error)) is not None:
            _write_error(f"error: {disk_error}")
            return disk_error.exit_code
        _write_error(traceback.format_exc())
        _write_error("This is a bug in bodycap. Please report the lines above, the command and the job file.")
        return EXIT_BUG
    return 0


def _disk_error(error: Exception) -> BodycapError | None:
    """Return the error for a disk that does not answer; None if `error` has another cause."""
    if not isinstance(error, OSError):
        return None
    from bodycap_batch.store.artefacts import store_error  # slow to import, and not needed for `--help`

    found = store_error(error, Path.cwd())
    return found if isinstance(found, DiskAway) else None


def _write_error(text: str) -> None:
    sys.stderr.write(text.rstrip() + "\n")
    sys.stderr.flush()
