"""Convert the validation errors of a job to messages that give the line, the field and advice."""

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

MAX_FURTHER = 5
"""Maximum number of problems that a message lists after the first problem. Evidence: none."""
_MISSING = "this key is missing"
_DID_YOU_MEAN = "did you mean "
_EXAMPLES = "the folder jobs/ has a commented example"
_EXPECTED = {
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
"""Description of the value that a field expects, for each error type of pydantic."""


class Problem(typing.NamedTuple):
    """One problem of a job.

    Attributes:
        location: Location of the problem in the job.
        message: Description of the problem.
        hint: Advice for the user; None if there is no advice.
    """

    location: Location
    message: str
    hint: str | None = None


def job_error(
    problems: Sequence[Problem], path: Path | None = None, source: YamlSource | None = None
) -> JobError:
    """Return one error for all problems: the first problem in full, further problems briefly.

    Args:
        problems: The problems, at least one.
        path: Path of the job; None if the values come from the command line.
        source: The YAML file of the job, for line numbers; None if there is no such file.
    """
    ordered = sorted(problems, key=lambda p: (source.line_of(p.location) or 0) if source else 0)
    first, further = ordered[0], ordered[1 : 1 + MAX_FURTHER]
    also = "".join(f"; also {_place(p, source)}: {p.message}" for p in further)
    return JobError(
        first.message + also,
        path=path,
        line=source.line_of(first.location) if source else None,
        field=dotted(first.location) or None,
        hint=first.hint,
    )


def _place(problem: Problem, source: YamlSource | None) -> str:
    line = source.line_of(problem.location) if source else None
    return " ".join(part for part in (f"line {line}" if line else "", dotted(problem.location)) if part)


def problems_of(
    error: ValidationError, model: type[BaseModel], data: object, *, hint: str = _EXAMPLES
) -> list[Problem]:
    """Convert pydantic's errors to problems.

    Args:
        error: The errors of pydantic.
        model: The pydantic model that refused the data.
        data: The refused data.
        hint: Advice for a problem that concerns no single field.
    """
    errors = error.errors(include_url=False)
    # If all items of a list are wrong, pydantic also reports that the list is too short. This second report
    # is omitted.
    reported = [e for e in errors if e["type"] != "too_short" or not _has_deeper(e, errors)]
    problems = _without_misspelt([_problem_of(details, model, data) for details in reported])
    return [p if p.hint else p._replace(hint=_description(p.location, model) or hint) for p in problems]


def _without_misspelt(problems: list[Problem]) -> list[Problem]:
    """Return the problems, but omit a missing key if a misspelling of this key is reported already."""
    intended = {
        (*problem.location[:-1], problem.hint.removeprefix(_DID_YOU_MEAN).strip("'?"))
        for problem in problems
        if problem.hint is not None and problem.hint.startswith(_DID_YOU_MEAN)
    }
    return [p for p in problems if p.message != _MISSING or p.location not in intended]


def _has_deeper(error: Any, errors: Sequence[Any]) -> bool:
    loc = error["loc"]
    return any(len(other["loc"]) > len(loc) and other["loc"][: len(loc)] == loc for other in errors)


def _problem_of(details: Any, model: type[BaseModel], data: object) -> Problem:
    kind = details["type"]
    location = _location_in(details["loc"], data, missing=kind == "missing")
    if kind == "extra_forbidden":
        return _unknown_key(location, model)
    if kind == "missing":
        return Problem(location, _MISSING, f"add `{location[-1]}:`")
    if kind in _EXPECTED:
        return Problem(location, f"{_short(details['input'])} should be {_EXPECTED[kind]}", None)
    if kind == "literal_error":
        return _not_among(location, details)
    if kind == "too_short" and not details["input"]:
        return Problem(location, "this list is empty", None)
    text = str(details["msg"]).removeprefix("Value error, ").replace("Input should be", "should be")
    if kind == "value_error":
        # The text of a rule for several fields starts with the name of the field that is wrong.
        name, colon, rest = text.partition(": ")
        if colon and name in known_keys(model, location):
            return Problem((*location, name), rest, None)
        return Problem(location, text, None)
    return Problem(location, f"{_short(details['input'])}: {text[0].lower()}{text[1:]}", None)


def _location_in(loc: Sequence[str | int], data: object, *, missing: bool) -> Location:
    """Return a location in the job, without the parts that pydantic inserts for members of union types."""
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


def _description(location: Location, model: type[BaseModel]) -> str | None:
    """Return the description of the field at a location, for the hint of a message.

    If the field has no description, the description of the nearest enclosing field is returned. None if there
    is no description at all.
    """
    while location:
        fields = _fields_at(location[:-1], model)
        text = fields[str(location[-1])].description if str(location[-1]) in fields else None
        if text:
            return f"{location[-1]}: {text}"
        location = location[:-1]
    return None


def _unknown_key(location: Location, model: type[BaseModel]) -> Problem:
    known = known_keys(model, location[:-1])
    near = difflib.get_close_matches(str(location[-1]), known, n=1)
    hint = f"{_DID_YOU_MEAN}{near[0]!r}?" if near else f"use one of these keys: {', '.join(known)}"
    return Problem(location, f"unknown key {str(location[-1])[:60]!r}", hint)


def _not_among(location: Location, details: Any) -> Problem:
    expected = str(details["ctx"]["expected"])
    words = [word.strip(" '") for word in expected.replace(" or ", ",").split(",")]
    near = difflib.get_close_matches(str(details["input"]), words, n=1)
    return Problem(
        location,
        f"{_short(details['input'])} is not one of {', '.join(words)}",
        f"did you mean {near[0]!r}?" if near else None,
    )


def known_keys(model: type[BaseModel], location: Location) -> list[str]:
    """Return the keys that a model allows at a location; empty if the location holds no block of keys."""
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
