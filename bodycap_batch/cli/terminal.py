"""Print to the terminal. All commands print with these functions.

Names of files and texts from files can hold characters that a terminal executes, or that imitate a line of
the output. These functions escape such characters.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sys
import textwrap
import time
from collections.abc import Iterable, Sequence
from typing import Any, TextIO

from bodycap_batch.core.errors import StoreError
from bodycap_batch.core.printable import printable


def print_line(text: str = "") -> None:
    """Print one line on standard output. Raises `StoreError` if standard output cannot be written."""
    _write_output(printable(text) + "\n")


def print_lines(lines: Iterable[str]) -> None:
    """Print lines as `print_line` does."""
    for line in lines:
        print_line(line)


def table_lines(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows of cells as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def print_text(text: str) -> None:
    """Print one line as `print_line` does; on a terminal, it breaks only between words."""
    _write_output(_wrapped(printable(text), sys.stdout) + "\n")


def print_json(value: Any, *, indent: int | None = None) -> None:
    """Print a JSON value on standard output, in ASCII. Raises `StoreError` if it cannot be written."""
    _write_output(json.dumps(value, indent=indent) + "\n")


def print_message(text: str) -> None:
    """Print one line on standard error. If standard error cannot be written, do nothing."""
    print_messages(printable(text))


def print_messages(text: str) -> None:
    """Print one or more lines on standard error. If standard error cannot be written, do nothing.

    On a terminal, lines break only between words.
    """
    lines = "".join(f"{_wrapped(printable(line), sys.stderr)}\n" for line in text.rstrip().split("\n"))
    with contextlib.suppress(OSError):
        sys.stderr.write(_encodable(lines, sys.stderr))
        sys.stderr.flush()


def print_timed_message(text: str) -> None:
    """Print one line on standard error, with the time of day in front of it."""
    print_message(f"{time.strftime('%H:%M:%S')} {text}")


def flush_output() -> None:
    """Write what is still in the buffer of standard output.

    Raises:
        StoreError: Standard output cannot be written, for example because its disk is full.
    """
    with contextlib.suppress(BrokenPipeError):  # the program that reads the output needs no more of it
        _write_output("")


def escape_unknown_characters() -> None:
    """Make standard output escape characters that its encoding does not have.

    This concerns texts that other libraries print, for example the help.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _write_output(text: str) -> None:
    try:
        sys.stdout.write(_encodable(text, sys.stdout))
        sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
        raise
    except OSError as error:
        _discard_output()
        raise StoreError(
            f"standard output cannot be written: {error.strerror or error}",
            hint="free some space on the disk of the output, or redirect the output to another disk",
        ) from error


def _discard_output() -> None:
    """Send standard output to nowhere. Otherwise Python fails again when it flushes the buffer at its end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _wrapped(line: str, stream: TextIO) -> str:
    """Return a line with breaks between words where a terminal would break it inside of them.

    The parts after the first one are indented by two more columns. Words that are longer than a line, such as
    paths, are not broken.
    """
    width = shutil.get_terminal_size().columns
    if not stream.isatty() or len(line) <= width:
        return line
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(
        line, width, subsequent_indent=f"{indent}  ", break_long_words=False, break_on_hyphens=False
    )


def _encodable(text: str, stream: TextIO) -> str:
    """Return the text with an escape for each character that the encoding of a stream does not have."""
    encoding = stream.encoding or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)
