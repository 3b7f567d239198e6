"""How good a figure is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Grade(IntEnum):
    """How far a result can be relied on; the worst of its criteria counts."""

    GOOD = 0
    FAIR = 1
    POOR = 2
    NONE = 3

    @property
    def word(self) -> str:
        """For a person."""
        return ("good", "usable with care", "poor", "no result")[self]


@dataclass(frozen=True, slots=True, kw_only=True)
class Criterion:
    """One graded figure.

    Attributes:
        about: ``cameras`` or ``body``: which half of the verdict it belongs to.
        name: What is judged.
        grade: How it is.
        says: The figure in words.
        why: Where the thresholds stand and for what reason.
        metric: Where ``metrics.json`` holds the figure, dotted; "" for what is derived from several.
        value: The figure itself.
    """

    about: str
    name: str
    grade: Grade
    says: str
    why: str
    metric: str = ""
    value: float | None = None


def graded(value: float, good: float, fair: float, *, more_is_better: bool = False) -> Grade:
    """Where a value stands between two bounds."""
    if more_is_better:
        value, good, fair = -value, -good, -fair
    return Grade.GOOD if value <= good else Grade.FAIR if value <= fair else Grade.POOR
