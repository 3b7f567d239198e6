"""Frozen dataclasses as ``<name>.json`` (structure and scalars) plus ``<name>.npz`` (arrays).

What is written follows the types of the fields, so every dataclass made of arrays, scalars, enums, paths,
tuples, mappings and other such dataclasses can be kept. A class with ``to_dict`` and ``from_dict`` is kept as
plain values. No pickle, and equal values give equal bytes.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import types
import typing
import zipfile
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bodycap_batch.core.errors import StoreError

T = TypeVar("T")
Arrays = dict[str, np.ndarray[Any, Any]]

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The earliest time a zip entry can carry; a constant, so that the bytes do not tell the clock."""


def write_bundle(value: Any, folder: Path, name: str) -> None:
    """Write a dataclass instance as ``<name>.json`` and, if it holds arrays, ``<name>.npz``.

    Args:
        value: The instance; its paths must lie below `folder` and are kept relative to it.
        folder: An existing folder.
        name: File stem.
    """
    arrays: Arrays = {}
    body = _encode(value, type(value), _Place(folder, arrays))
    document = {"type": type(value).__name__, "value": body}
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    if arrays:
        write_npz(folder / f"{name}.npz", arrays)


def read_bundle(cls: type[T], folder: Path, name: str) -> T:
    """Read what `write_bundle` wrote.

    Raises:
        StoreError: A file is missing, broken, or holds another type.
    """
    path = folder / f"{name}.json"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["type"] != cls.__name__:
            raise StoreError(f"holds a {document['type']}, not a {cls.__name__}", path=path)
        archive = folder / f"{name}.npz"
        arrays = read_npz(archive) if archive.exists() else {}
        return typing.cast(T, _decode(document["value"], cls, _Place(folder, arrays)))
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        hint = "remove the folder; it is made again by the next run"
        raise StoreError(f"cannot be read: {error}", path=path, hint=hint) from error


def write_npz(path: Path, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write arrays as an uncompressed .npz whose bytes depend on the arrays alone."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), buffer.getbuffer())


def read_npz(path: Path) -> Arrays:
    """Read all arrays of a .npz; pickled objects are refused."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@dataclasses.dataclass(frozen=True, slots=True)
class _Place:
    """Where a value stands: its folder, all arrays, and the name of the value itself."""

    folder: Path
    arrays: Arrays
    name: str = ""

    def inner(self, part: object) -> _Place:
        name = f"{self.name}.{part}" if self.name else str(part)
        return dataclasses.replace(self, name=name)


def _encode(value: Any, hint: Any, place: _Place) -> Any:  # noqa: PLR0911 - one case a kind of type
    hint = _strip_none(hint)
    origin = typing.get_origin(hint) or hint
    if value is None:
        return None
    if origin is np.ndarray:
        place.arrays[place.name] = value
        return place.name
    if hasattr(hint, "to_dict"):
        return _plain(value.to_dict())
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        names = [field.name for field in dataclasses.fields(hint)]
        return {name: _encode(getattr(value, name), hints[name], place.inner(name)) for name in names}
    if origin is tuple:
        inner = _item_hints(hint, len(value))
        return [_encode(value[i], inner[i], place.inner(i)) for i in range(len(value))]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        inner_hint = (*typing.get_args(hint), Any, Any)[1]
        return {str(key): _encode(value[key], inner_hint, place.inner(key)) for key in value}
    if isinstance(origin, type) and issubclass(origin, Enum):
        return value.value
    if isinstance(origin, type) and issubclass(origin, Path):
        return Path(value).resolve().relative_to(place.folder.resolve()).as_posix()
    if origin is float:
        return float(value) if math.isfinite(value) else str(float(value))
    return _plain(value)


def _decode(value: Any, hint: Any, place: _Place) -> Any:  # noqa: PLR0911 - one case a kind of type
    hint = _strip_none(hint)
    origin = typing.get_origin(hint) or hint
    if value is None:
        return None
    if origin is np.ndarray:
        return place.arrays[value]
    if hasattr(hint, "from_dict"):
        return hint.from_dict(value)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        parts = {name: _decode(part, hints[name], place.inner(name)) for name, part in value.items()}
        return typing.cast(type, hint)(**parts)
    if origin is tuple:
        inner = _item_hints(hint, len(value))
        return tuple(_decode(value[i], inner[i], place.inner(i)) for i in range(len(value)))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        inner_hint = (*typing.get_args(hint), Any, Any)[1]
        return {key: _decode(part, inner_hint, place.inner(key)) for key, part in value.items()}
    if isinstance(origin, type) and issubclass(origin, Enum):
        return origin(value)
    if isinstance(origin, type) and issubclass(origin, Path):
        return place.folder / value
    return float(value) if origin is float else value


def _strip_none(hint: Any) -> Any:
    """X for ``X | None``; other hints as they are."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        return kinds[0] if len(kinds) == 1 else Any
    return hint


def _item_hints(hint: Any, count: int) -> tuple[Any, ...]:
    hints = typing.get_args(hint)
    return (hints[0],) * count if len(hints) == 2 and hints[1] is Ellipsis else hints


def _plain(value: Any) -> Any:
    """A value of no declared type as JSON; what is not a finite number becomes null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"cannot be kept as JSON: {type(value).__name__}")
