"""The errors that are reported to users. Each error has an exit code, and it can have a hint.

Any exception of another type is a bug. It ends the program with the exit code `EXIT_BUG`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from bodycap_batch.core.printable import printable

EXIT_BUG = 70
"""Exit code after an unexpected exception. Source: EX_SOFTWARE of sysexits.h."""

NO_MOTION_HINT = (
    "did the recordings freeze, or were the cameras not worn? Record a person who walks about; a camera that "
    "stands still can be left out"
)
"""Hint of the errors about a capture in which no camera moves."""

EXIT_CANCELLED = 130
"""Exit code after the user stopped the program. Source: shells report 128 + SIGINT (2)."""


_MAX_FURTHER = 5
"""Maximum number of errors that a message lists after the first error. Evidence: none."""


class BodycapError(Exception):
    """Base class of the errors that a user can understand and correct.

    Args:
        message: Description of the problem, in one sentence.
        path: File that the error concerns.
        line: Number of the line in this file, counted from 1.
        field: Name of the field in the job file, with dots (``capture.cameras.0.video``).
        hint: Advice on what the user can do.
    """

    exit_code = EXIT_BUG

    def __init__(
        self,
        message: str,
        *,
        path: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
        hint: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.path = None if path is None else str(path)
        self.line = line
        self.field = field
        self.hint = hint

    def __str__(self) -> str:
        """Return the error as text for the user: one line, and a second line if there is a hint."""
        return f"{self._first_line()}\n  hint: {printable(self.hint)}" if self.hint else self._first_line()

    @property
    def one_line(self) -> str:
        """The error as one line: place, message, and the hint in brackets."""
        return f"{self._first_line()} ({printable(self.hint)})" if self.hint else self._first_line()

    def _first_line(self) -> str:
        where = ":".join(str(part) for part in (self.path, self.line) if part is not None)
        return printable(": ".join(part for part in (where, self.field, self.message) if part))

    def to_dict(self) -> dict[str, str | int | None]:
        """Return the error as plain JSON values. `error_from_dict` restores the error in another process."""
        return {
            "type": type(self).__name__,
            "message": self.message,
            "path": self.path,
            "line": self.line,
            "field": self.field,
            "hint": self.hint,
            "exit_code": self.exit_code,
        }


class JobError(BodycapError):
    """The job file or the command line contains an error, or a file that they name contains an error."""

    exit_code = 2


class CaptureError(BodycapError):
    """A video, a calibration or a file of timestamps cannot be used."""

    exit_code = 3


class EstimationError(BodycapError):
    """The data do not determine the result."""

    exit_code = 4


class ImplausibleBody(EstimationError):
    """The cameras fit no person together. A wrong position of one camera is a possible cause."""


class StoreError(BodycapError):
    """A file cannot be written, a stored artefact is damaged, or the cluster's scheduler was lost."""

    exit_code = 5


class RequirementUnmet(BodycapError):
    """The results were written, but they do not reach the grade or the coverage that the job requires."""

    exit_code = 6


class DiskAway(StoreError):
    """A disk does not respond, for example an unreachable network disk. A later attempt may succeed."""


class OutOfMemory(BodycapError):
    """A task needs more memory than it may use, or than the machine has."""


class Cancelled(BodycapError):
    """The user stopped the work."""

    exit_code = EXIT_CANCELLED


def one_line(error: Exception) -> str:
    """Return an error as one line for the user."""
    return error.one_line if isinstance(error, BodycapError) else printable(str(error))


_ERROR_TYPES = {
    cls.__name__: cls
    for cls in (
        JobError,
        CaptureError,
        EstimationError,
        ImplausibleBody,
        StoreError,
        RequirementUnmet,
        DiskAway,
        OutOfMemory,
        Cancelled,
    )
}


def error_from_dict(data: dict[str, str | int | None]) -> BodycapError:
    """Restore an error from the values of `BodycapError.to_dict`. An unknown type gives a `BodycapError`."""
    cls = _ERROR_TYPES.get(str(data.get("type")), BodycapError)
    line = data.get("line")
    return cls(
        str(data.get("message")),
        path=None if data.get("path") is None else str(data["path"]),
        line=None if line is None else int(line),
        field=None if data.get("field") is None else str(data["field"]),
        hint=None if data.get("hint") is None else str(data["hint"]),
    )


def worst_exit_code(codes: Iterable[int]) -> int:
    """Return the exit code of several jobs: the largest; any failure outranks an unmet requirement."""
    return max(codes, key=lambda code: (code not in (0, RequirementUnmet.exit_code), code), default=0)


def one_error(errors: Sequence[BodycapError]) -> BodycapError:
    """Return the first error. Its message lists the other errors, too, so that all are corrected at once."""
    first, *others = errors
    for other in others[:_MAX_FURTHER]:
        where = ": ".join(part for part in (other.path, other.field) if part)
        first.message += f"; also {f'{where}: ' if where else ''}{other.message}"
    return first
