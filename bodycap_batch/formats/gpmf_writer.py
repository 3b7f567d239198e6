"""Write GPMF, the key-length-value format of GoPro's telemetry and settings.

Source: the GPMF key-length-value format, published by GoPro.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bodycap_batch.formats.atomic_files import store_error_from_os_error
from bodycap_batch.formats.gpmf import DTYPES


def header(key: str, kind: int, size: int, count: int) -> bytes:
    """Return the header of an item: key, type, size of a sample in bytes and number of samples."""
    return struct.pack(">4sBBH", key.encode("latin-1"), kind, size, count)


def item(key: str, kind: str, values: str | npt.ArrayLike, columns: int = 1) -> bytes:
    """Return an item with numbers of one type, or with text.

    Args:
        key: Key of four letters.
        kind: Type of the values, one letter; "c" for text.
        values: The text, or the numbers of all samples.
        columns: Number of values of a sample.
    """
    if kind == "c":
        content = str(values).encode("latin-1")
        size, count = 1, len(content)
    else:
        flat = np.asarray(values).ravel().astype(DTYPES[kind])
        content, size, count = flat.tobytes(), flat.itemsize * columns, len(flat) // columns
    return header(key, ord(kind), size, count) + content + b"\0" * (-len(content) % 4)


def nested(key: str, *items: bytes) -> bytes:
    """Return an item that contains other items."""
    content = b"".join(items)
    return header(key, 0, 1, len(content)) + content + b"\0" * (-len(content) % 4)


def append_settings(path: Path, settings: Mapping[str, str]) -> None:
    """Append a box with settings to an MP4 file, as GoPro cameras store them (``moov/udta/GPMF``).

    Args:
        path: The file.
        settings: The settings as text, by key of four letters.

    Raises:
        StoreError: The file cannot be written.
    """
    box = nested("DEVC", *(item(key, "c", value) for key, value in settings.items()))
    for kind in (b"GPMF", b"udta", b"moov"):
        box = struct.pack(">I4s", len(box) + 8, kind) + box
    try:
        with path.open("ab") as file:
            file.write(box)
    except OSError as error:
        raise store_error_from_os_error(error, path) from error
