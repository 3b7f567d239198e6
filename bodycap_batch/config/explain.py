"""Turn a validation error into a line, a field, a sentence and a remedy."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bodycap_batch.config.yaml_source import Location, YamlSource, dotted
from bodycap_batch.core.errors import JobError

_ALSO = 5
_MISSING = "this is missing"
_MEANT = "did you mean "
_WANTED = {
    "string_type": "text",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a block of `key: value` lines",
    "model_type": "a block of `key: value` lines",
    "path_type": "a path",
}


class Problem(typing.NamedTuple):
    """One thing wrong with a job: where, what, and what to do."""

    location: Location
    message: str
    hint: str | None = None


def job_error(problems: Sequence[Problem], path: Path, source: YamlSource | None = None) -> JobError:
    """Make one error of all problems: the first in full, the others briefly."""
    ordered = sorted(problems, key=lambda p: (source.line_of(p.location) or 0) if source else 0)
    first, others = ordered[0], ordered[1 : 1 + _ALSO]
    also = "".join(f"\n  also {_where(p, source)}: {p.message}" for p in others)
    return JobError(
        first.message + also,
        path=path,
        line=source.line_of(first.location) if source else None,
        field=dotted(first.location) or None,
        hint=first.hint,
    )


def _where(problem: Problem, source: YamlSource | None) -> str:
    line = source.line_of(problem.location) if source else None
    return " ".join(part for part in (f"line {line}" if line else "", dotted(problem.location)) if part)


def problems_of(error: ValidationError, model: type[BaseModel], data: object) -> list[Problem]:
    """Translate pydantic's errors."""
    errors = error.errors(include_url=False)
    # A list whose items are all wrong is also called too short: the items' errors say it better.
    told = [e for e in errors if e["type"] != "too_short" or not _has_deeper(e, errors)]
    problems = _without_misspelt([_problem(details, model, data) for details in told])
    return [p if p.hint else p._replace(hint=_meaning(p.location, model)) for p in problems]


def _without_misspelt(problems: list[Problem]) -> list[Problem]:
    """A key that is missing because it was misspelt is told once, as the misspelling."""
    meant = {
        (*problem.location[:-1], problem.hint.removeprefix(_MEANT).strip("'?"))
        for problem in problems
        if problem.hint is not None and problem.hint.startswith(_MEANT)
    }
    return [p for p in problems if p.message != _MISSING or p.location not in meant]


def _has_deeper(error: Any, errors: Sequence[Any]) -> bool:
    loc = error["loc"]
    return any(len(other["loc"]) > len(loc) and other["loc"][: len(loc)] == loc for other in errors)


def _problem(details: Any, model: type[BaseModel], data: object) -> Problem:
    kind = details["type"]
    location = _present(details["loc"], data, missing=kind == "missing")
    if kind == "extra_forbidden":
        return _unknown_key(location, model)
    if kind == "missing":
        return Problem(location, _MISSING, f"add `{location[-1]}:`")
    if kind in _WANTED:
        return Problem(location, f"{_short(details['input'])} should be {_WANTED[kind]}", None)
    if kind == "literal_error":
        return _not_among(location, details)
    if kind == "too_short" and not details["input"]:
        return Problem(location, "this is an empty list", None)
    text = str(details["msg"]).removeprefix("Value error, ").replace("Input should be", "should be")
    if kind == "value_error":
        return Problem(location, text, None)
    return Problem(location, f"{_short(details['input'])}: {text[0].lower()}{text[1:]}", None)


def _present(loc: Sequence[str | int], data: object, *, missing: bool) -> Location:
    """Drop what pydantic adds to a location (names of union members)."""
    kept: list[str | int] = []
    for position, part in enumerate(loc):
        inside = (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        )
        if inside:
            kept.append(part)
            data = data[part]  # type: ignore[index]
        elif missing and position == len(loc) - 1:
            kept.append(part)
    return tuple(kept)


def _meaning(location: Location, model: type[BaseModel]) -> str:
    """What the field at a location, or the nearest one around it, is for."""
    while location:
        fields = _fields_at(location[:-1], model)
        about = fields[str(location[-1])].description if str(location[-1]) in fields else None
        if about:
            return f"{location[-1]}: {about}"
        location = location[:-1]
    return "jobs/cpl_lab.yaml is a commented example"


def _unknown_key(location: Location, model: type[BaseModel]) -> Problem:
    known = known_keys(model, location[:-1])
    near = difflib.get_close_matches(str(location[-1]), known, n=1)
    hint = f"{_MEANT}{near[0]!r}?" if near else f"known here: {', '.join(known)}"
    return Problem(location, f"unknown key {str(location[-1])[:60]!r}", hint)


def _not_among(location: Location, details: Any) -> Problem:
    expected = str(details["ctx"]["expected"])
    words = [word.strip(" '") for word in expected.replace(" or ", ",").split(",")]
    near = difflib.get_close_matches(str(details["input"]), words, n=1)
    return Problem(
        location,
        f"{_short(details['input'])} is none of {', '.join(words)}",
        f"did you mean {near[0]!r}?" if near else None,
    )


def known_keys(model: type[BaseModel], location: Location) -> list[str]:
    """Keys allowed at a location of a model (empty where it is no model)."""
    return list(_fields_at(location, model))


def _fields_at(location: Location, model: type[BaseModel]) -> dict[str, FieldInfo]:
    models = [model]
    for part in location:
        if isinstance(part, str):
            fields = [m.model_fields[part].annotation for m in models if part in m.model_fields]
            models = [found for annotation in fields for found in _models_in(annotation)]
    return {key: field for m in models for key, field in m.model_fields.items()}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in typing.get_args(annotation) for found in _models_in(argument)]


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
