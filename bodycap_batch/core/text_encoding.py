"""Decode text that a user's editor or another program has saved.

Programs for Windows begin UTF-8 with a byte-order mark, and some save UTF-16. Every reader of a user's text
file decodes it with this module. `json.loads` does the same if it is given bytes.
"""

from __future__ import annotations

import codecs
from pathlib import Path

_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def encoding_of(start: bytes) -> str:
    """Return Python's name of the encoding of a text, which removes the byte-order mark.

    Args:
        start: The first two bytes of the text, or more.
    """
    return "utf-16" if start.startswith(_UTF16_MARKS) else "utf-8-sig"


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Return bytes as text: UTF-16 if a byte-order mark says so, else UTF-8.

    Args:
        data: The bytes, from the start of the file.
        errors: As in `bytes.decode`. With ``strict``, other bytes raise `UnicodeDecodeError`.
    """
    return data.decode(encoding_of(data), errors)


def encoding_of_file(path: Path) -> str:
    """Return Python's name of the encoding of a file, for `open`. Raises `OSError` if it is unreadable."""
    with path.open("rb") as stream:
        return encoding_of(stream.read(2))
