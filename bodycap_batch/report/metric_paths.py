"""Dotted paths of the values in ``metrics.json``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_PART = re.compile(r"(?:\\.|[^.\\])+")
_ESCAPED = re.compile(r"\\(.)")


def metric_path(*parts: str | int) -> str:
    r"""Return the dotted path of nested keys and list indices.

    A dot in a key, for example in a camera name, is written ``\.``; a backslash is written ``\\``.
    """
    return ".".join(re.sub(r"([.\\])", r"\\\1", str(part)) for part in parts)


def metric_at(metrics: Mapping[str, Any], path: str) -> Any:
    """Return the value at a path of nested mappings and lists, or None if the path does not exist.

    Args:
        metrics: The content of ``metrics.json``.
        path: The path, as `metric_path` returns it.
    """
    value: Any = metrics
    for part in _PART.findall(path):
        key = _ESCAPED.sub(r"\1", part)
        if isinstance(value, list):
            value = value[int(key)] if int(key) < len(value) else None
        else:
            value = value.get(key) if isinstance(value, Mapping) else None
    return value
