"""Convert task dataclasses to JSON, and select the part of a task that identifies its result in the store.

The pipeline writes a task with `to_json`. It makes the key of the task's artefact with `key_inputs` and
`key_options`. The child process reads the task back with `from_json`. A field may be a dataclass, a pydantic
model, a path or a JSON value. It may also be a mapping or tuple of these, or optional (``X | None``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from pydantic import BaseModel, TypeAdapter

_Loaded = TypeVar("_Loaded")
_OPTIONS = "options"
"""Name of the task's field that holds the stage's options. An artefact's key stores the options separately
from the inputs."""
_OMITTED = "omitted from the key"


@runtime_checkable
class Reference(Protocol):
    """A value that refers to content by its path. An artefact's key holds the content's digest instead."""

    def key_content(self) -> Any:
        """Return the digests that identify the content."""


def omitted_from_key(*names: str) -> Mapping[str, Any]:
    """Return metadata for a dataclass field that the artefact's key omits, entirely or in part.

    Args:
        names: Names of the parts of the field's value that the key omits; without names, the key omits the
            whole field.
    """
    return {_OMITTED: names}


def to_json(value: Any) -> Any:
    """Return a task, or a part of a task, as plain JSON values; paths become strings."""
    return _plain(value, lambda reference: _fields(reference, to_json))


def from_json(kind: type[_Loaded], data: Any) -> _Loaded:
    """Rebuild a task from the JSON values that `to_json` returned."""
    return TypeAdapter(kind).validate_python(data)


def key_inputs(task: Any) -> dict[str, Any]:
    """Return the inputs of a task for the artefact's key: the digest of each input replaces its path."""
    return {
        field.name: _without(_keyed(getattr(task, field.name)), field)
        for field in dataclasses.fields(task)
        if field.name != _OPTIONS and field.metadata.get(_OMITTED) != ()
    }


def key_options(task: Any) -> dict[str, Any]:
    """Return the options of a task for the artefact's key, as JSON values; empty without options."""
    for field in dataclasses.fields(task):
        if field.name == _OPTIONS:
            return dict(_without(to_json(task.options), field))
    return {}


def _keyed(value: Any) -> Any:
    return _plain(value, lambda reference: reference.key_content())


def _without(value: Any, field: dataclasses.Field[Any]) -> Any:
    names = field.metadata.get(_OMITTED, ())
    return {name: part for name, part in value.items() if name not in names} if names else value


def _plain(value: Any, describe: Callable[[Any], Any]) -> Any:
    """Convert a value to plain JSON values; `describe` converts each `Reference` inside the value."""

    def plain(part: Any) -> Any:
        return _plain(part, describe)

    if isinstance(value, Reference):
        return describe(value)
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value):
        return _fields(value, plain)
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return [plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def _fields(value: Any, plain: Callable[[Any], Any]) -> dict[str, Any]:
    return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
