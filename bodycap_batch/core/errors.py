"""The exceptions a user can meet, each with an exit code and a remedy."""

from __future__ import annotations

from pathlib import Path

EXIT_OK = 0
EXIT_BUG = 70
EXIT_CANCELLED = 130


class BodycapError(Exception):
    """Something a user can understand and act upon.

    Args:
        message: What is wrong, in one sentence.
        path: The file it concerns.
        line: 1-based line in that file.
        field: The job's field, dotted (``capture.cameras.0.video``).
        hint: What to do about it.
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
        where = ":".join(str(part) for part in (self.path, self.line) if part is not None)
        parts = [part for part in (where, self.field, self.message) if part]
        text = ": ".join(parts)
        return f"{text}\n  hint: {self.hint}" if self.hint else text

    def to_dict(self) -> dict[str, str | int | None]:
        """Return the error as plain JSON values (crosses the process boundary)."""
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
    """The job file or the command line is wrong."""

    exit_code = 2


class CaptureError(BodycapError):
    """Videos, calibration or timestamps cannot be used."""

    exit_code = 3


class EstimationError(BodycapError):
    """The data did not support an answer."""

    exit_code = 4


class StoreError(BodycapError):
    """The disk or a stored artefact failed."""

    exit_code = 5


class DiskAway(StoreError):
    """The disk does not answer (a network disk that is away, a failing one); trying again later may help."""


class Cancelled(BodycapError):
    """The user stopped the work."""

    exit_code = EXIT_CANCELLED


_ERROR_TYPES = {
    cls.__name__: cls for cls in (JobError, CaptureError, EstimationError, StoreError, DiskAway, Cancelled)
}


def error_from_dict(data: dict[str, str | int | None]) -> BodycapError:
    """Rebuild an error that `BodycapError.to_dict` wrote."""
    cls = _ERROR_TYPES.get(str(data.get("type")), BodycapError)
    line = data.get("line")
    return cls(
        str(data.get("message")),
        path=None if data.get("path") is None else str(data["path"]),
        line=None if line is None else int(line),
        field=None if data.get("field") is None else str(data["field"]),
        hint=None if data.get("hint") is None else str(data["hint"]),
    )
