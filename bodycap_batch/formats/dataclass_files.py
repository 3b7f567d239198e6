"""Store frozen dataclasses as ``<name>.json`` (structure and scalars) and ``<name>.npz`` (arrays).

The declared types of the fields determine the format. The supported types are arrays, scalars, enums, paths,
tuples, mappings, and dataclasses of these types. A class with ``to_dict`` and ``from_dict`` is stored as
plain JSON values. Pickle is not used. Equal values give equal bytes.
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


def write_dataclass(value: Any, folder: Path, name: str) -> None:
    """Write a dataclass instance as ``<name>.json`` and, if it contains arrays, ``<name>.npz``.

    Args:
        value: The instance. Paths in the instance must be below `folder`, and are stored relative to
            `folder`.
        folder: Existing folder for the files.
        name: Name of the files without suffix.
    """
    arrays: Arrays = {}
    encoded = _convert(value, type(value), _Location(folder, arrays), writes=True)
    document = {"type": type(value).__name__, "value": encoded}
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    if arrays:
        write_npz(folder / f"{name}.npz", arrays)


def read_dataclass(cls: type[T], folder: Path, name: str) -> T:
    """Read a dataclass instance that `write_dataclass` has written.

    Raises:
        StoreError: A file is missing or damaged, or contains an instance of another class.
    """
    path = folder / f"{name}.json"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["type"] != cls.__name__:
            raise StoreError(f"the folder contains a {document['type']}, not a {cls.__name__}", path=path)
        archive = folder / f"{name}.npz"
        arrays = read_npz(archive) if archive.exists() else {}
        value = _convert(document["value"], cls, _Location(folder, arrays), writes=False)
        return typing.cast(T, value)
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        hint = "remove the folder; the next run creates the folder again"
        raise StoreError(f"the stored result cannot be read: {error}", path=path, hint=hint) from error


def write_npz(path: Path, arrays: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write arrays as an uncompressed .npz file. Equal names and arrays always give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            # The date of a ZipInfo is a constant, so that equal arrays give equal bytes.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), buffer.getbuffer())


def read_npz(path: Path) -> Arrays:
    """Read all arrays of a .npz file. Pickled objects are refused."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@dataclasses.dataclass(frozen=True, slots=True)
class _Location:
    """The position of a value in the dataclass instance that is written or read.

    Attributes:
        folder: Folder that the stored paths are relative to.
        arrays: All arrays of the instance. The keys are the dotted names of the arrays.
        name: Dotted name of the value; "" for the instance itself.
    """

    folder: Path
    arrays: Arrays
    name: str = ""

    def inner(self, part: object) -> _Location:
        """Return the position of a field or an element of the value at this position."""
        name = f"{self.name}.{part}" if self.name else str(part)
        return dataclasses.replace(self, name=name)


def _convert(value: Any, hint: Any, at: _Location, *, writes: bool) -> Any:  # noqa: PLR0911 - one return per kind of type
    """Convert a value of type `hint` to JSON values and arrays, or these back to the value.

    Args:
        value: The value, or its JSON values.
        hint: Declared type of the value.
        at: Position of the value. Its arrays are added to `at.arrays`, or taken from it.
        writes: True to convert to JSON values, False to convert back.
    """
    hint = _strip_none(hint)
    origin = typing.get_origin(hint) or hint
    kind = origin if isinstance(origin, type) else object
    if value is None:
        return None
    if kind is np.ndarray:
        if not writes:
            return at.arrays[value]
        at.arrays[at.name] = value
        return at.name
    if hasattr(hint, "to_dict" if writes else "from_dict"):
        return json_value(value.to_dict()) if writes else hint.from_dict(value)
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        found = (
            {each.name: getattr(value, each.name) for each in dataclasses.fields(hint)} if writes else value
        )
        parts = {
            name: _convert(part, hints[name], at.inner(name), writes=writes) for name, part in found.items()
        }
        return parts if writes else typing.cast(type, hint)(**parts)
    if kind is tuple:
        inner = zip(value, _element_hints(hint, len(value)), strict=True)
        elements = [
            _convert(each, inner_hint, at.inner(index), writes=writes)
            for index, (each, inner_hint) in enumerate(inner)
        ]
        return elements if writes else tuple(elements)
    if issubclass(kind, Mapping):
        inner_hint = (*typing.get_args(hint), Any, Any)[1]
        return {
            str(key): _convert(part, inner_hint, at.inner(key), writes=writes) for key, part in value.items()
        }
    if issubclass(kind, Enum):
        return value.value if writes else kind(value)
    if issubclass(kind, Path):
        folder = at.folder.resolve()
        return Path(value).resolve().relative_to(folder).as_posix() if writes else at.folder / value
    if kind is float:
        return float(value) if not writes or math.isfinite(value) else str(float(value))
    return json_value(value) if writes else value


def _strip_none(hint: Any) -> Any:
    """Return the type X for the type hint ``X | None``.

    For any other union, return Any. Return a type hint that is not a union unchanged.
    """
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        return kinds[0] if len(kinds) == 1 else Any
    return hint


def _element_hints(hint: Any, count: int) -> tuple[Any, ...]:
    """Return the type hints of the elements of a tuple type with `count` elements."""
    hints = typing.get_args(hint)
    return (hints[0],) * count if len(hints) == 2 and hints[1] is Ellipsis else hints


def json_value(value: Any) -> Any:
    """Convert a value without a declared type to JSON values. NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(part) for part in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return json_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"cannot be stored as JSON: {type(value).__name__}")
