"""The entry point of the `bodycap` command. Errors are converted to messages and exit codes."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Any

import typer

from bodycap_batch.cli import (  # noqa: F401 - each module registers its commands
    batch,
    calibrate,
    check,
    evaluate,
    export,
    look,
    run,
    skeleton,
    spool,
    sync,
    synth,
    telemetry,
    watch,
    why,
)
from bodycap_batch.cli.application import app
from bodycap_batch.cli.environment import error_of_environment, require_usable_paths
from bodycap_batch.cli.signals import raise_on_signal, signal_exit_code
from bodycap_batch.cli.terminal import (
    escape_unknown_characters,
    flush_output,
    print_message,
    print_messages,
)
from bodycap_batch.core.errors import EXIT_BUG, BodycapError, Cancelled, StoreError

__all__ = ["main"]

_UsageError: type[Exception] = typer.BadParameter.__mro__[1]
"""Type of the errors of the command line. Newer versions of Typer have their own copy of this type; older
versions use the type of Click."""
_HELP = frozenset({"-h", "--help", "--version"})
"""Arguments that print a text and do nothing else."""


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
    escape_unknown_characters()
    try:
        if _HELP.isdisjoint(arguments):
            require_usable_paths(arguments)
        code = app(list(arguments), prog_name="bodycap", standalone_mode=False)
        flush_output()
    except _UsageError as error:
        return _print_usage_error(error)
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else 0
    except Cancelled as error:
        print_messages(str(error))
        return signal_exit_code()
    except BodycapError as error:
        return _print_error(error)
    except Exception as error:  # noqa: BLE001 - the only place where bugs are caught
        return _print_unexpected_error(error)
    return code if isinstance(code, int) else 0


def _print_error(error: BodycapError) -> int:
    """Print an error with its notes, and return its exit code."""
    print_messages(f"error: {error}")
    for note in getattr(error, "__notes__", []):
        print_messages(note)
    return error.exit_code


def _print_unexpected_error(error: Exception) -> int:
    """Print an error that no command reports itself, and return its exit code."""
    try:
        flush_output()
    except StoreError as full:
        return _print_error(full)
    if (known := error_of_environment(error)) is not None:
        return _print_error(known)
    print_messages("".join(traceback.format_exception(error)))
    print_message("This is a bug in bodycap. Please report the lines above, the command and the job.")
    return EXIT_BUG


def _print_usage_error(error: Any) -> int:
    """Print an error of the command line, and return its exit code."""
    message = str(error.format_message())
    if error.ctx is None or message == error.ctx.get_help():  # a command without arguments prints its help
        print_messages(message)
        return int(error.exit_code)
    print_messages(error.ctx.get_usage())
    print_message(f"Try '{error.ctx.command_path} --help' for help.")
    print_message(f"error: {message}")
    return int(error.exit_code)
