"""Parse the text of a BVH file. Error messages name the line."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import encoding_of
from bodycap_batch.core.unique_names import unique_name

_CHANNELS = {name.lower(): name for axis in "XYZ" for name in (f"{axis}position", f"{axis}rotation")}
"""Channel names as the BVH specification spells them. The keys are the same names in lower case."""

_MAX_JOINTS = 10_000
"""Maximum number of joints. Derivation: a production skeleton with face and fingers has a few hundred joints,
so a file with more joints than this maximum is not a skeleton."""


@dataclass(slots=True)
class FileJoint:
    """One ROOT or JOINT block, in the axes and units of the file.

    Attributes:
        name: Name of the joint, unique in the file.
        parent: Index of the parent; −1 for the root.
        line: Number of the line at which the block starts, counted from 1.
        offset: (3,) OFFSET of the joint; None before it is read.
        end: (3,) OFFSET of the End Site; None if the joint has no End Site.
        channels: Names of the channels, in the order of the file.
        children: Number of child joints.
    """

    name: str
    parent: int
    line: int
    offset: FloatArray | None = None
    end: FloatArray | None = None
    channels: tuple[str, ...] = ()
    children: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class BvhFile:
    """The content of a BVH file.

    Attributes:
        joints: The joints in the order of the file. Every parent comes before its children.
        values: (T, channels) values of the MOTION block; None if the file has no frames.
        frame_time: Value of the Frame Time as text; "" if the file has no frames.
    """

    joints: list[FileJoint]
    values: FloatArray | None
    frame_time: str


def parse_bvh(path: Path) -> BvhFile:
    """Parse a BVH file.

    Raises:
        JobError: The file is missing or malformed. The error names the line.
    """
    try:
        with open(path, "rb") as handle:
            is_utf16 = encoding_of(handle.peek(2)) == "utf-16"
            rows = (
                (row.encode() for row in io.TextIOWrapper(handle, "utf-16", "replace"))
                if is_utf16
                else iter(handle)
            )
            lines = _LineReader(path, rows)
            joints, at_motion = _read_hierarchy(lines)
            size_bytes = path.stat().st_size
            values, frame_time = _read_motion(lines, joints, size_bytes) if at_motion else (None, "")
    except OSError as error:
        raise JobError(
            f"the file cannot be read: {error.strerror or error}", path=path, hint="correct the path"
        ) from error
    return BvhFile(joints=joints, values=values, frame_time=frame_time)


@dataclass
class _LineReader:
    """Reader that returns the statements of a file one by one. Its errors name the current line."""

    path: Path
    source: Iterator[bytes]
    number: int = 0
    pending: list[str] = field(default_factory=list)

    def next(self) -> str | None:
        """Return the next statement; None at the end of the file. Each brace is a separate statement."""
        while not self.pending:
            raw = next(self.source, None)
            if raw is None:
                return None
            self.number += 1
            text = _decode(raw).replace("{", "\n{\n").replace("}", "\n}\n")
            self.pending = [part for line in text.split("\n") if (part := " ".join(line.split()))]
        return self.pending.pop(0)

    def error(self, message: str, *, line: int | None = None, hint: str | None = None) -> JobError:
        """Return a `JobError` that names the given line, or the current line if none is given."""
        return JobError(
            message,
            path=self.path,
            line=self.number if line is None else line,
            hint=hint or "export the skeleton again as BVH, or use a preset: `skeleton: auto`",
        )


def _decode(raw: bytes) -> str:
    """Decode a line as UTF-8. If this fails, decode the line as Latin-1."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _read_hierarchy(lines: _LineReader) -> tuple[list[FileJoint], bool]:
    """Parse the HIERARCHY block.

    Returns:
        The joints, and a flag: True if MOTION follows the block, False if the file ends after the block.
    """
    if (lines.next() or "").upper() != "HIERARCHY":
        raise lines.error(
            "the file does not begin with HIERARCHY, as a BVH file must", line=max(lines.number, 1)
        )
    joints: list[FileJoint] = []
    stack: list[int | None] = []  # for each open block, the index of the joint; None for an End Site
    opening: list[int | None] = []  # the block whose opening brace must follow
    at_motion = False
    while (text := lines.next()) is not None:
        keyword = text.split(" ", 1)[0].upper()
        if keyword.startswith("MOTION"):
            at_motion = True
            break
        if keyword == "{":
            if not opening:
                raise lines.error("there is no ROOT, JOINT or End Site before this opening brace")
            stack.append(opening.pop())
        elif opening:
            raise lines.error(f"there is {text[:40]!r} where an opening brace must be")
        elif keyword == "}":
            if not stack:
                raise lines.error("there is no opening brace for this closing brace")
            stack.pop()
        else:
            _read_statement(lines, text, joints, stack, opening)
    if stack or opening:
        raise lines.error(
            "the file ends before the hierarchy is complete", hint="export the file again: its end is missing"
        )
    _check_joints(lines, joints)
    return joints, at_motion


def _read_statement(
    lines: _LineReader, text: str, joints: list[FileJoint], stack: list[int | None], opening: list[int | None]
) -> None:
    """Parse a ROOT, JOINT, End Site, OFFSET or CHANNELS line.

    Args:
        lines: The reader of the file.
        text: The line.
        joints: All joints so far. A new joint is appended.
        stack: For each open block, the index of the joint; None for an End Site.
        opening: The block whose opening brace must follow. A new block is appended.
    """
    keyword, _, rest = text.partition(" ")
    keyword = keyword.upper()
    if keyword in ("ROOT", "JOINT"):
        inside = stack[-1] if stack else None
        if keyword == "ROOT" and joints:
            raise lines.error(
                "the file contains a second ROOT", hint="export only one skeleton into the file"
            )
        if keyword == "JOINT" and inside is None:
            raise lines.error("this JOINT is outside of ROOT or inside an End Site")
        if len(joints) >= _MAX_JOINTS:
            raise lines.error(f"the file has more than {_MAX_JOINTS} joints")
        parent = -1 if inside is None else inside
        name = unique_name(rest or f"joint{len(joints)}", {joint.name for joint in joints})
        joints.append(FileJoint(name, parent, lines.number))
        if parent >= 0:
            joints[parent].children += 1
        opening.append(len(joints) - 1)
        return
    if keyword == "END":
        if not stack or stack[-1] is None:
            raise lines.error("this End Site is outside of a joint")
        opening.append(None)
        return
    if keyword not in ("OFFSET", "CHANNELS"):
        raise lines.error(f"the keyword {text.split(' ', 1)[0][:40]!r} is unknown")
    if not stack:
        raise lines.error(f"{keyword} is outside of a joint")
    if keyword == "OFFSET":
        _read_offset(lines, rest, joints, stack)
    elif stack[-1] is not None:
        joints[stack[-1]].channels = _read_channels(lines, rest)


def _read_offset(lines: _LineReader, rest: str, joints: list[FileJoint], stack: list[int | None]) -> None:
    """Parse an OFFSET line and store it in the joint of the innermost open block."""
    numbers = [_parse_number(lines, token) for token in rest.split()]
    if len(numbers) != 3:
        raise lines.error(f"OFFSET needs 3 numbers, but has {len(numbers)}")
    inside = stack[-1]
    if inside is None:
        owner = next(index for index in reversed(stack) if index is not None)
        joints[owner].end = np.array(numbers)
    else:
        joints[inside].offset = np.array(numbers)


def _read_channels(lines: _LineReader, rest: str) -> tuple[str, ...]:
    """Parse a CHANNELS line and return the channel names."""
    count, *names = rest.split() or [""]
    if not count.isdigit() or int(count) != len(names):
        raise lines.error(f"CHANNELS {count or '?'} is followed by {len(names)} names of channels")
    unknown = [name for name in names if name.lower() not in _CHANNELS]
    if unknown:
        raise lines.error(
            f"the channel {unknown[0]!r} is unknown",
            hint=f"use only these channels: {', '.join(_CHANNELS.values())}",
        )
    channels = tuple(_CHANNELS[name.lower()] for name in names)
    positions = [name for name in channels if name.endswith("position")]
    if len(set(positions)) != len(positions):
        raise lines.error("one joint has the same position channel twice")
    return channels


def _check_joints(lines: _LineReader, joints: list[FileJoint]) -> None:
    """Raise `JobError` if there is no root, or if a joint has no OFFSET."""
    if not joints:
        raise lines.error("the hierarchy contains no ROOT")
    for joint in joints:
        if joint.offset is None:
            raise lines.error(f"joint {joint.name!r} has no OFFSET", line=joint.line)


def _parse_number(lines: _LineReader, token: str) -> float:
    """Parse a finite number. A comma is accepted as decimal point."""
    try:
        value = float(token.replace(",", "."))
    except ValueError:
        raise lines.error(f"{token[:40]!r} is not a number") from None
    if not math.isfinite(value):
        raise lines.error(f"{token[:40]!r} is not a finite number")
    return value


def _read_motion(
    lines: _LineReader, joints: list[FileJoint], size_bytes: int
) -> tuple[FloatArray | None, str]:
    """Parse the MOTION block.

    Returns:
        The values (T, channels), and the Frame Time as text. Returns (None, "") if the file has no frames.
    """
    frames = _read_header(lines, "FRAMES")
    if frames is None:
        return None, ""
    count = _parse_number(lines, frames)
    if count < 0 or count != int(count):
        raise lines.error(f"the number of frames is {frames}, which is not possible")
    if count == 0:
        return None, ""
    frame_time = _read_header(lines, "FRAME TIME")
    if frame_time is None:
        raise lines.error("the line with the Frame Time is missing")
    if _parse_number(lines, frame_time) < 0 or (_parse_number(lines, frame_time) == 0 and count > 1):
        raise lines.error(f"the Frame Time is {frame_time}, but must be positive")
    width = sum(len(joint.channels) for joint in joints)
    total = int(count) * width
    if 2 * total > size_bytes + 1:  # every value needs at least a digit and a separator
        raise lines.error(
            f"the file has only {size_bytes} bytes, which cannot contain {int(count)} frames of {width} "
            "channels",
            hint="export the file again: its end is missing, or its number of Frames is wrong",
        )
    values = np.empty(total)
    done = 0
    while done < total and (text := lines.next()) is not None:
        row = _parse_row(lines, text)[: total - done]
        values[done : done + len(row)] = row
        done += len(row)
    if done < total:
        raise lines.error(
            f"the file contains only {done} of the {total} values of the motion ({int(count)} frames of "
            f"{width} channels)",
            hint="export the file again: its end is missing, or its number of Frames is wrong",
        )
    return values.reshape(int(count), width), frame_time


def _read_header(lines: _LineReader, label: str) -> str | None:
    """Parse a line ``label: value`` and return the value. Return None at the end of the file."""
    text = lines.next()
    if text is None:
        return None
    name, colon, value = text.partition(":")
    value = value.strip()
    if not colon or name.strip().upper() != label or len(value.split()) != 1:
        raise lines.error(f"there is {text[:40]!r} where '{label.title()}: <number>' must be")
    return value


def _parse_row(lines: _LineReader, text: str) -> list[float]:
    """Parse a line of finite numbers."""
    tokens = text.split()
    try:
        row = [float(token) for token in tokens]
    except ValueError:
        return [_parse_number(lines, token) for token in tokens]
    if not all(map(math.isfinite, row)):
        raise lines.error("the motion contains NaN or infinity")
    return row
