"""Small JSON files that carry a checksum, so that a damaged file is not believed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

CHECKSUM = "checksum"
"""Name of the field that holds the SHA-256 of all other fields."""


def checked_json(document: Mapping[str, Any]) -> str:
    """Return an object as indented JSON text, with a field that holds the checksum of the object."""
    values = json.loads(json.dumps(document))
    return json.dumps({**values, CHECKSUM: _digest(values)}, indent=1) + "\n"


def parse_checked_json(data: bytes) -> dict[str, Any]:
    """Return the object that `checked_json` wrote, without its checksum.

    A file of an earlier program version, or of another program, may have no checksum. Such a file is accepted
    as it is.

    Raises:
        ValueError: The bytes are not a JSON object, or the checksum does not match.
    """
    found = json.loads(data.decode("utf-8"))
    if not isinstance(found, dict):
        raise ValueError("not a JSON object")
    checksum = found.pop(CHECKSUM, None)
    if checksum is not None and checksum != _digest(found):
        raise ValueError("the checksum does not match")
    return found


def _digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode("ascii")).hexdigest()
