"""Compare written JSON files with the schemas that the package ships."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from jsonschema import Draft202012Validator
from referencing import Registry, Resource

NAMES = ("verdict", "metrics", "run")


def schema(name: str) -> dict[str, Any]:
    """Return a schema as it is shipped."""
    text = (files("bodycap_batch") / "schemas" / f"{name}.schema.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def closed(value: Any) -> Any:
    """Return a schema in which no object may have further keys.

    The shipped schemas allow further keys, because keys can be added at any time. Tests do not, so that each
    key that is written is described.
    """
    if isinstance(value, list):
        return [closed(each) for each in value]
    if not isinstance(value, Mapping):
        return value
    found = {key: closed(each) for key, each in value.items()}
    is_schema_of_object = isinstance(found.get("properties"), dict) and "type" in found
    return {**found, "additionalProperties": False} if is_schema_of_object else found


def problems(name: str, document: object) -> list[str]:
    """Return what is wrong with a document, by the schema of that name without further keys."""
    resources = [(f"{each}.schema.json", Resource.from_contents(closed(schema(each)))) for each in NAMES]
    validator = Draft202012Validator(
        {"$ref": f"{name}.schema.json"}, registry=Registry().with_resources(resources)
    )
    return [f"{error.json_path}: {error.message[:200]}" for error in validator.iter_errors(document)]
