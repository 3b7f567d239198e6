"""Read a YAML file as plain values, with the line number of each value.

Scalars follow the core schema of YAML 1.2: ``no``, ``1:30`` and dates stay text, ``1e-3`` is a number.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import yaml

from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import decode_text

MAX_BYTES = 1 << 20
"""Maximum size (bytes) of a job file or a calibration file. Real files: some kilobytes. Evidence: none."""
MAX_DEPTH = 20
"""Maximum nesting depth (levels) of a job or a calibration file. Both need six levels. Evidence: none."""

Location = tuple[str | int, ...]
"""Location of a value: the keys and list positions from the top of the file, such as
``("capture", "cameras", 0, "video")``."""

_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_WORDS: dict[str, bool | None] = {"": None, "~": None, "null": None, "Null": None, "NULL": None}
_WORDS |= {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_TAB_INDENT = re.compile(r" *\t")
_MAX_INT = 1 << 63
"""A number is refused if its absolute value is this value or larger. Reason: such an integer does not fit
into int64."""


@dataclass(frozen=True, slots=True, kw_only=True)
class YamlSource:
    """A parsed YAML file.

    Attributes:
        path: Path of the file.
        data: Content of the file: dicts with text keys, lists, texts, numbers, booleans, None.
        lines: Line number (counted from 1) of each value, by the value's location. It is the line of the
            value's key, or the line of the item in a list.
    """

    path: Path
    data: object
    lines: dict[Location, int]

    def line_of(self, location: Location) -> int | None:
        """Return the line of the value at a location.

        If this line is unknown, return the line of the nearest enclosing value with a known line. Return None
        if there is no such value.
        """
        while location not in self.lines:
            if not location:
                return None
            location = location[:-1]
        return self.lines[location]


def read_yaml(path: Path, *, max_bytes: int = MAX_BYTES, max_depth: int = MAX_DEPTH) -> YamlSource:
    """Read a YAML file of at most `max_bytes`, nested at most `max_depth` levels deep.

    Raises:
        JobError: The file is unreadable, too large, nested too deep, or not YAML. The error is also raised
            for a repeated key, an anchor, an alias or a tag. The error names the line if the line is known.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise JobError(
                "the file is too large for a job file", path=path, hint="give the YAML file of the job"
            )
        text = decode_text(path.read_bytes())
    except FileNotFoundError as error:
        raise JobError(
            "there is no such job file", path=path, hint="give a YAML file or a folder of videos"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise JobError(
            f"the job cannot be read ({error})", path=path, hint="give a YAML file, saved as UTF-8"
        ) from error
    try:
        _refuse_unsupported(text, path, max_depth)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        raise _syntax_error(error, text, path) from error
    except (yaml.YAMLError, ValueError) as error:
        raise JobError(
            f"the file is not valid YAML: {error}".splitlines()[0],
            path=path,
            hint="save the file as plain UTF-8 text",
        ) from error
    lines: dict[Location, int] = {}
    data = None if node is None else _value(node, (), lines, path)
    return YamlSource(path=path, data=data, lines=lines)


def _refuse_unsupported(text: str, path: Path, max_depth: int) -> None:
    """Refuse too deep nesting, anchors, aliases and tags, before the file is read recursively."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        line = 0 if event.start_mark is None else event.start_mark.line + 1
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > max_depth:
                message = f"the blocks of the file are nested deeper than {max_depth} levels"
                raise JobError(message, path=path, line=line, hint="use fewer levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        for feature, mark in (("anchor", "& or *"), ("tag", "!")):
            if getattr(event, feature, None) is not None:
                raise JobError(
                    f"{feature}s are not allowed in jobs ({getattr(event, feature)})",
                    path=path,
                    line=line,
                    hint=f'write the value out; put text that starts with {mark} in quotes "..."',
                )


def _syntax_error(error: yaml.MarkedYAMLError, text: str, path: Path) -> JobError:
    mark = error.problem_mark or error.context_mark
    line = None if mark is None else mark.line + 1
    tabbed = next((n for n, row in enumerate(text.splitlines(), 1) if _TAB_INDENT.match(row)), None)
    if tabbed is not None or "'\\t'" in str(error.problem):
        return JobError(
            "the line contains a tab where YAML needs spaces",
            path=path,
            line=tabbed or line,
            hint="indent with spaces, not tabs",
        )
    problem = " ".join(part for part in (error.problem, error.context) if part)
    hint = "check the indentation, the colons and the quotes on this line and on the line before"
    return JobError(f"the file is not valid YAML: {problem}", path=path, line=line, hint=hint)


def _value(node: yaml.Node, location: Location, lines: dict[Location, int], path: Path) -> object:
    """Return a YAML node as plain values; record in `lines` the lines of the node and of its values."""
    lines.setdefault(location, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        return _mapping(node, location, lines, path)
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, (*location, index), lines, path) for index, item in enumerate(node.value)]
    return _scalar(node, location, path)


def _mapping(
    node: yaml.MappingNode, location: Location, lines: dict[Location, int], path: Path
) -> dict[str, object]:
    out: dict[str, object] = {}
    for key_node, value_node in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise JobError(
                "a key must be a word", path=path, line=line, hint="write each entry as `key: value`"
            )
        key = str(key_node.value)
        here = (*location, key)
        if key in out:
            raise JobError(
                f"the key {key!r} is given twice, the first time on line {lines[here]}",
                path=path,
                line=line,
                field=dotted(here),
                hint="keep only one of the two entries",
            )
        lines[here] = line
        out[key] = _value(value_node, here, lines, path)
    return out


def _scalar(node: yaml.Node, location: Location, path: Path) -> object:
    """Return the value of a scalar according to the core schema of YAML 1.2; quoted text stays text.

    Numbers out of range are refused, except the parameters of a calibration: the check of the calibration
    names their plausible values.
    """
    text = str(node.value)
    if getattr(node, "style", None) is not None:
        return text
    if text in _WORDS:
        return _WORDS[text]
    number: int | float
    if _INT.fullmatch(text) and len(text) < 20:
        number = int(text)
    elif _FLOAT.fullmatch(text):
        number = float(text)
    else:
        return text
    in_range = math.isfinite(number) and abs(number) < _MAX_INT
    if not in_range and location[-3:-1] != ("calibration", "params"):
        raise JobError(
            f"the number {text[:40]} is out of range",
            path=path,
            line=node.start_mark.line + 1,
            field=dotted(location) or None,
            hint="correct the number",
        )
    return number


def dotted(location: Location) -> str:
    """Return a location as text for messages: ``capture.cameras.0.video``."""
    return ".".join(str(part) for part in location)
