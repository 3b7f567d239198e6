"""GPMF, the key-length-value format in which GoPro cameras store telemetry and settings.

Each item has a header of eight bytes: a key of four letters, the type of its values, the size of one sample
in bytes, and the number of samples. An item of type 0 contains other items. Each item is padded to a multiple
of four bytes. Numbers are big-endian.

Damaged data never raise an error: what cannot be read is left out, and `Damage` names the reason.

Source: the GPMF key-length-value format, published by GoPro.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.file_completeness import boxes

_CONTAINER_BOXES = (b"moov", b"udta")
_GOPRO_BOX = b"GPMF"
_MAX_BOX_BYTES = 1 << 20
"""Maximum size (bytes) of a box of settings that is read. A larger box is damaged. Evidence: none."""
_MAX_BOXES = 10_000
"""Maximum number of boxes of an MP4 file that are read. Real files have some hundred. Evidence: none."""
_MAX_BOX_DEPTH = 8
"""Maximum depth of boxes inside boxes. The settings of real files are at depth 3. Evidence: none."""
_FIRMWARE_MODELS = {
    "HD3": "HERO3", "HD4": "HERO4", "HD5": "HERO5 Black", "HX5": "HERO5 Session", "HD6": "HERO6 Black",
    "HD7": "HERO7 Black", "HD8": "HERO8 Black", "HD9": "HERO9 Black", "H19": "GoPro Max",
    "H21": "HERO10 Black", "H22": "HERO11 Black", "H23": "HERO12 Black", "H24": "HERO13 Black",
    "FS1": "Fusion",
}  # fmt: skip
"""Model by start of the firmware's name. The file of an old camera names only its firmware."""
_LENS_MODES = {
    "W": "Wide", "L": "Linear", "N": "Narrow", "S": "SuperView", "M": "Medium", "X": "Max SuperView",
    "H": "HyperView",
}  # fmt: skip
"""Lens mode by the setting VFOV."""
_OFF = ("", "N", "N/A", "NA", "OFF", "NONE")
MAX_PAYLOAD_BYTES = 8 << 20
"""Maximum size (bytes) of a payload that is read. Real payloads hold a second and have 5 to 100 kilobytes.
Evidence: none."""
_MAX_ITEMS = 20_000
"""Maximum number of items of a payload. Real payloads have some hundred. Evidence: none."""
_MAX_DEPTH = 8
"""Maximum depth of items inside items. Real payloads have a depth of 3. Evidence: none."""
_MAX_COLUMNS = 256
"""Maximum number of values of one sample: a sample has at most 255 bytes."""

DTYPES = {
    "b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
    "f": ">f4", "d": ">f8", "q": ">i4", "Q": ">i8", "F": "S4", "c": "S1", "G": "S16", "U": "S16",
}  # fmt: skip
"""numpy's name of each type of a value."""
_TEXT_TYPES = ("F", "c", "G", "U")
_FIXED_POINT = {"q": 2.0**-16, "Q": 2.0**-32}
"""Value of the last bit of each fixed-point type: the types are Q15.16 and Q31.32."""
_REPEATED = re.compile(r"([A-Za-z])(?:\[(\d{1,3})\])?")


@dataclass(frozen=True, slots=True)
class GpmfItem:
    """One item.

    Attributes:
        key: Key of four letters.
        kind: Type of the values, one letter; "" for an item that contains other items, "?" for samples whose
            types another item (TYPE) gives.
        size: Size of one sample, bytes.
        count: Number of samples.
        content: The values as bytes.
        children: The items in this item.
    """

    key: str
    kind: str
    size: int
    count: int
    content: memoryview
    children: tuple[GpmfItem, ...] = ()

    def text(self) -> str:
        """Return the values as text."""
        return bytes(self.content).decode("latin-1").strip("\0 ")

    def child(self, key: str) -> GpmfItem | None:
        """Return the first item with a key in this item."""
        return next((item for item in self.children if item.key == key), None)

    def values(self, types: str = "") -> FloatArray | None:
        """Return the samples (N,C) as numbers; None if they are not numbers or are damaged.

        Args:
            types: Types of the values of one sample, from the item TYPE, for an item of kind "?".
        """
        expanded = _expanded_types(types) if self.kind == "?" else self._own_types()
        if not expanded or any(kind in _TEXT_TYPES for kind in expanded):
            return None
        dtype = np.dtype([(f"f{index}", DTYPES[kind]) for index, kind in enumerate(expanded)])
        if dtype.itemsize > self.size:
            return None
        count = len(self.content) // self.size
        samples = np.frombuffer(self.content, np.uint8, count * self.size).reshape(count, self.size)
        rows = np.ascontiguousarray(samples[:, : dtype.itemsize]).view(dtype)[:, 0]
        out = np.empty((len(rows), len(expanded)))
        with np.errstate(invalid="ignore"):  # some NaN are reported when they are converted
            for index, kind in enumerate(expanded):
                out[:, index] = rows[f"f{index}"].astype(np.float64) * _FIXED_POINT.get(kind, 1.0)
        return out

    def _own_types(self) -> str:
        if self.kind not in DTYPES:
            return ""
        columns, rest = divmod(self.size, np.dtype(DTYPES[self.kind]).itemsize)
        return "" if rest else self.kind * columns


def _expanded_types(types: str) -> str:
    """Return the types of one sample with repetitions written out: ``f[3]B`` gives ``fffB``."""
    out = ""
    for kind, count in _REPEATED.findall(types.strip()):
        if kind not in DTYPES:
            return ""
        out += kind * int(count or 1)
        if len(out) > _MAX_COLUMNS:
            return ""
    return out


class Damage(Counter[str]):
    """The kinds of damage that were found, in the order of the first occurrence, with their numbers."""

    def add(self, kind: str) -> None:
        """Count one occurrence of a kind of damage."""
        self[kind] += 1

    def notes(self) -> list[str]:
        """Return one sentence for each kind of damage."""
        return [f"{kind} ({count} times)" if count > 1 else kind for kind, count in self.items()]


def read_items(data: bytes, damage: Damage) -> tuple[GpmfItem, ...]:
    """Read the items of one payload.

    Args:
        data: The payload.
        damage: Collects the kinds of damage.

    Returns:
        The items that can be read.
    """
    if len(data) > MAX_PAYLOAD_BYTES:
        damage.add("a payload of telemetry is too large and is not used")
        return ()
    return _Reader(damage).items(memoryview(data), 0)


class _Reader:
    """Reads nested items, and counts them over all depths."""

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._left = _MAX_ITEMS

    def items(self, data: memoryview, depth: int) -> tuple[GpmfItem, ...]:
        found: list[GpmfItem] = []
        offset = 0
        while offset + 8 <= len(data):
            raw_key, kind, size, count = struct.unpack_from(">4sBBH", data, offset)
            if raw_key == b"\0\0\0\0":  # padding at the end
                break
            if not _is_key(raw_key):
                self._damage.add("a part of the telemetry has no readable key")
                break
            if self._left <= 0:
                self._damage.add("a payload of telemetry has too many items")
                break
            self._left -= 1
            start, length = offset + 8, size * count
            content = data[start : start + length]
            if len(content) < length:
                self._damage.add("an item of the telemetry is cut off")
                count = len(content) // size
                content = content[: count * size]
            found.append(self._item(raw_key.decode("latin-1"), kind, (size, count), content, depth))
            offset = start + (length + 3) // 4 * 4
        return tuple(found)

    def _item(self, key: str, kind: int, shape: tuple[int, int], content: memoryview, depth: int) -> GpmfItem:
        if kind:
            return GpmfItem(key, chr(kind), *shape, content)
        if depth >= _MAX_DEPTH:
            self._damage.add("items of the telemetry are nested too deeply")
            return GpmfItem(key, "", *shape, content)
        return GpmfItem(key, "", *shape, content, self.items(content, depth + 1))


def _is_key(raw: bytes) -> bool:
    return all(48 <= byte <= 57 or 65 <= byte <= 90 or 97 <= byte <= 122 or byte in b" _-" for byte in raw)


def gopro_settings(path: Path) -> dict[str, str]:
    """Return the settings of a GoPro camera, by four-letter key.

    The result is empty if the file is not from a GoPro camera, or if it cannot be read.

    The settings are in the box ``moov/udta/GPMF`` of an MP4 file.
    """
    try:
        with path.open("rb") as stream:
            found = _inner_boxes(stream, 0, stream.seek(0, 2), _MAX_BOX_DEPTH)
            for kind, content, stop in itertools.islice(found, _MAX_BOXES):
                if kind == _GOPRO_BOX and stop - content <= _MAX_BOX_BYTES:
                    stream.seek(content)
                    return dict(_text_items(read_items(stream.read(stop - content), Damage())))
    except OSError:
        return {}
    return {}


def gopro_model(settings: Mapping[str, str], firmware: str, device: str) -> str:
    """Return the name of the camera model; "" if it is unknown.

    Args:
        settings: The settings of the file.
        firmware: Name of the firmware; "" if it is not given.
        device: Name of the device in the track; "" if it is not given.
    """
    stated = settings.get("MINF", "")
    if stated:
        return stated
    if device and device not in ("Camera", "Highlights"):
        return device
    return _FIRMWARE_MODELS.get(firmware[:3].upper(), "")


def gopro_lens_mode(settings: Mapping[str, str]) -> str:
    """Return the lens mode that the settings of a GoPro give; "" if they do not give it."""
    return _LENS_MODES.get(settings.get("VFOV", ""), settings.get("VFOV", ""))


def gopro_stabilisation(settings: Mapping[str, str]) -> str:
    """Return the mode of the stabilisation, "off", or "" if the settings do not give it."""
    mode = settings.get("EISA", "")
    switch = settings.get("EISE", mode)
    if "EISE" not in settings and "EISA" not in settings:
        return ""
    if switch.upper() in _OFF:
        return "off"
    return mode if mode.upper() not in (*_OFF, "Y") else "on"


def _inner_boxes(stream: BinaryIO, start: int, end: int, depth: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield the type, the start of the content and the end of the boxes between two positions.

    The boxes inside the boxes that lead to the settings are yielded too.
    """
    for kind, _, content, stop in boxes(stream, start, end):
        yield kind, content, stop
        if kind in _CONTAINER_BOXES and depth:
            yield from _inner_boxes(stream, content, min(stop, end), depth - 1)


def _text_items(items: tuple[GpmfItem, ...]) -> Iterator[tuple[str, str]]:
    """Yield the key and the value of each item that contains text, including nested items."""
    for item in items:
        if item.kind == "c":
            yield item.key, item.text()
        yield from _text_items(item.children)
