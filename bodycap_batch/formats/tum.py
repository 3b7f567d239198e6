"""TUM trajectory files: one line ``timestamp tx ty tz qx qy qz qw`` per pose.

The timestamp is in seconds. The translation and the quaternion are the pose world_from_camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import encoding_of_file
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.model.geometry import make_transform, quat_xyzw_from_rotation, rotation_from_quat_xyzw

_NS_PER_S = 1_000_000_000
"""Nanoseconds per second."""

_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_COMMENT_PREFIXES = ("#", "%", "//", ";")
_HEADER_WORDS = ("timestamp", "time", "t")


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedPoses:
    """N poses in the order of time.

    Attributes:
        times_ns: (N,) times, nanoseconds, increasing.
        world_from_cam: (N,4,4) poses of the camera in the world.
    """

    times_ns: IntArray
    world_from_cam: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)
        set_array(self, "world_from_cam", (len(self.times_ns), 4, 4))
        if (np.diff(self.times_ns) <= 0).any():
            raise ValueError("times_ns: must increase")


def read_tum(path: Path | str) -> TimedPoses:
    """Read the poses of a TUM trajectory file.

    The file may have comments, a header line, commas or tabs between the numbers, and CRLF line ends. The
    poses are sorted by time. If several lines have the same time, only the first of these lines is used. A
    file that contains only comments gives no poses. Such a file belongs to a camera without localised frames.

    Raises:
        JobError: The file is missing, malformed or empty. The error for a malformed line names the line.
    """
    path = Path(path)
    times: list[int] = []
    rows: list[list[float]] = []
    headed = False
    try:
        with open(path, encoding=encoding_of_file(path), errors="replace") as handle:
            for number, line in enumerate(handle, start=1):
                words = line.replace(",", " ").split()
                if not words:
                    continue
                if words[0].startswith(_COMMENT_PREFIXES) or (not rows and words[0].lower() in _HEADER_WORDS):
                    headed = True
                    continue
                time_ns, row = _parse_line(path, number, words)
                times.append(time_ns)
                rows.append(row)
    except OSError as error:
        raise JobError(
            f"the file cannot be read: {error.strerror or error}", path=path, hint="correct the path"
        ) from error
    if not rows and not headed:
        raise JobError(
            "the file contains no poses", path=path, hint=f"write one pose on each line: {_COLUMNS}"
        )
    times_ns, first = np.unique(np.array(times, dtype=np.int64), return_index=True)
    table = np.array(rows).reshape(-1, 7)[first]
    poses = make_transform(rotation_from_quat_xyzw(table[:, 3:]), table[:, :3])
    return TimedPoses(times_ns=times_ns, world_from_cam=poses)


def _parse_line(path: Path, number: int, words: list[str]) -> tuple[int, list[float]]:
    """Return the time in nanoseconds and the seven numbers of the pose of one line."""
    time_ns, row = 0, [0.0]
    problem, hint = "", f"write one pose on each line: {_COLUMNS}"
    try:
        time_ns, row = nanoseconds(words[0]), [float(word) for word in words[1:]]
    except (ValueError, InvalidOperation, OverflowError):
        problem = "the line contains a word that is not a number"
    if len(words) != 8:
        problem = f"the line has {len(words)} columns, but must have 8"
    elif not problem and (not np.isfinite(row).all() or abs(time_ns) >= 2**63):
        problem = "the line contains NaN, infinity or a time out of range"
        hint = "leave out the lines of frames without a pose"
    elif not problem and np.linalg.norm(row[3:]) < 1e-6:
        problem, hint = "the quaternion is zero", "write the quaternion in the order qx qy qz qw"
    if problem:
        raise JobError(problem, path=path, line=number, hint=hint)
    return time_ns, row


def write_tum(path: Path, poses: TimedPoses, comments: Sequence[str] = ()) -> None:
    """Write a TUM trajectory file.

    All numbers have nine decimals, so the resolution is one nanosecond and one billionth of the unit of
    length.

    Args:
        path: Path of the file, which is replaced atomically.
        poses: The poses.
        comments: Comment lines for the top of the file, without ``#``.

    Raises:
        StoreError: The file cannot be written.
    """
    quats = quat_xyzw_from_rotation(poses.world_from_cam[:, :3, :3])
    lines = [f"# {comment}\n" for comment in (*comments, _COLUMNS)]
    for time_ns, position, quat in zip(
        poses.times_ns.tolist(), poses.world_from_cam[:, :3, 3], quats, strict=True
    ):
        numbers = " ".join(f"{value:.9f}" for value in (*position, *quat))
        lines.append(f"{seconds_text(time_ns)} {numbers}\n")
    write_text(path, "".join(lines))


def seconds_text(time_ns: int) -> str:
    """Return a time in nanoseconds as seconds with nine decimals."""
    sign = "-" if time_ns < 0 else ""
    whole, rest = divmod(abs(int(time_ns)), _NS_PER_S)
    return f"{sign}{whole}.{rest:09d}"


def nanoseconds(text: str) -> int:
    """Return a time in seconds, written as a decimal number of any length, in nanoseconds.

    Raises:
        ArithmeticError: The text is not a finite number.
    """
    return int((Decimal(text) * _NS_PER_S).to_integral_value())
