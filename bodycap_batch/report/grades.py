"""Grades of results, and the criteria behind them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Grade(IntEnum):
    """Reliability of a result. The grade of a result is the worst grade of the result's criteria."""

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
    """One graded value.

    Attributes:
        subject: The part of the verdict that uses the criterion: ``cameras`` or ``body``.
        name: Name of the graded quantity.
        grade: Grade of the value.
        finding: The value in words.
        rationale: The bounds of the grades, and the reason for these bounds.
        metric: Dotted path of the value in ``metrics.json``; "" if it is derived from several values.
        value: The value; None if the criterion is not numerical.
    """

    subject: str
    name: str
    grade: Grade
    finding: str
    rationale: str
    metric: str = ""
    value: float | None = None


def grade_value(value: float, good: float, fair: float, *, more_is_better: bool = False) -> Grade:
    """Grade a value by two bounds.

    Args:
        value: The value to grade.
        good: Bound of the grade "good": the largest good value, or the smallest good value if
            `more_is_better` is True.
        fair: Bound of the grade "usable with care". A value beyond this bound is "poor".
        more_is_better: True if large values are better than small values.
    """
    if more_is_better:
        value, good, fair = -value, -good, -fair
    return Grade.GOOD if value <= good else Grade.FAIR if value <= fair else Grade.POOR
