"""The `bodycap` command: where errors become messages and exit codes."""

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
    "synth",
    "view",
    "watch",
    "why",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The words after ``bodycap``; default those of the process.

    Returns:
        The exit code. Without `arguments` the process is left with it.
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
    except Exception as error:  # noqa: BLE001 - the one place where bugs are caught
        if (away := _disk_error(error)) is not None:
            _write_error(f"error: {away}")
            return away.exit_code
        _write_error(traceback.format_exc())
        _write_error("This is a bug in bodycap. Please report the lines above, the command and the job file.")
        return EXIT_BUG
    return 0


def _disk_error(error: Exception) -> BodycapError | None:
    """A disk that does not answer, which no look at a path expects; None for anything else."""
    if not isinstance(error, OSError):
        return None
    from bodycap_batch.store.artefacts import store_error  # takes longer than all else about `--help`

    found = store_error(error, Path.cwd())
    return found if isinstance(found, DiskAway) else None


def _write_error(text: str) -> None:
    sys.stderr.write(text.rstrip() + "\n")
    sys.stderr.flush()
