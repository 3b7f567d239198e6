"""Grades of results, and a graded criterion."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any


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
class Bounds:
    """The bounds of a criterion's grades.

    Attributes:
        good: The last value that is "good".
        fair: The last value that is "usable with care"; None if no value is "poor".
        more_is_better: True if large values are better than small values.
    """

    good: float
    fair: float | None = None
    more_is_better: bool = False

    def grade(self, value: float) -> Grade:
        """Return the grade of a value."""
        sign = -1.0 if self.more_is_better else 1.0
        if sign * value <= sign * self.good:
            return Grade.GOOD
        return Grade.FAIR if self.fair is None or sign * value <= sign * self.fair else Grade.POOR


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """One change for the next capture.

    Attributes:
        action: The change that the user should make, in the words of a film maker.
        reason: The measurement that justifies the change.
        priority: Importance of the advice. Larger values are shown first.
        how: Commands and settings for the change; "" if the action needs none.
    """

    action: str
    reason: str
    priority: float
    how: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the advice as plain JSON values."""
        return {"action": self.action, "reason": self.reason, "how": self.how}


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
        unit: Unit of the value; "" if it has none.
        bounds: The bounds of the grades; None if the criterion is not numerical.
        advice: The change that improves the value; None if none is known, or if the grade is "good".
    """

    subject: str
    name: str
    grade: Grade
    finding: str
    rationale: str
    metric: str = ""
    value: float | None = None
    unit: str = ""
    bounds: Bounds | None = None
    advice: Advice | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the criterion as plain JSON values, as in ``verdict.json``."""
        bounds = None
        if self.bounds is not None:
            more = self.bounds.more_is_better
            bounds = {
                "good": self.bounds.good,
                "usable_with_care": self.bounds.fair,
                "better": "higher" if more else "lower",
            }
        return {
            "name": self.name,
            "grade": self.grade.word,
            "value": self.value,
            "unit": self.unit,
            "bounds": bounds,
            "finding": self.finding,
            "reason": self.rationale,
            "advice": None if self.advice is None else self.advice.to_dict(),
            "metric": self.metric,
        }
