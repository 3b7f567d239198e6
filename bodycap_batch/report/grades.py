"""Grades of results."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Grade(IntEnum):
    """Reliability of a result. The worst grade of its criteria is the grade of the result."""

    GOOD = 0
    FAIR = 1
    POOR = 2
    NONE = 3

    @property
    def word(self) -> str:
        """The grade in words."""
        return ("good", "usable with care", "poor", "no result")[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class Criterion:
    """One graded figure.

    Attributes:
        subject: ``cameras`` or ``body``: the half of the verdict to which the criterion belongs.
        name: What is judged.
        grade: Its grade.
        finding: The figure in words.
        rationale: The bounds of the grades and the reason for them.
        metric: Dotted path of the figure in ``metrics.json``; "" if it is derived from several figures.
        value: The figure.
    """

    subject: str
    name: str
    grade: Grade
    finding: str
    rationale: str
    metric: str = ""
    value: float | None = None


def grade_value(value: float, good: float, fair: float, *, more_is_better: bool = False) -> Grade:
    """Grade a value by the bounds of the grades "good" and "usable with care"."""
    if more_is_better:
        value, good, fair = -value, -good, -fair
    return Grade.GOOD if value <= good else Grade.FAIR if value <= fair else Grade.POOR
