"""What a result must reach, for scripts that go on only with good results: a grade, and a coverage."""

from __future__ import annotations

from dataclasses import dataclass

REQUIRED_GRADES = ("good", "usable", "poor")
"""Grades that can be required, the best one first; ``poor`` requires a result only."""
REQUIREMENT_HINT = (
    f"write a grade ({', '.join(REQUIRED_GRADES)}) and, after a comma, the share of the recording that must "
    "be delivered, for example good,0.9"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """The worst grade and the smallest coverage that a result may have.

    Attributes:
        grade: One of `REQUIRED_GRADES`.
        coverage: Smallest share of the recording that must be delivered, from 0 to 1.
    """

    grade: str
    coverage: float

    @staticmethod
    def from_text(text: str) -> Requirement:
        """Return the requirement that a text such as ``good,0.9`` states. Raises `ValueError`."""
        grade, _, share = (word.strip() for word in text.partition(","))
        if grade not in REQUIRED_GRADES:
            raise ValueError(f"{grade[:60]!r} is not a grade; {REQUIREMENT_HINT}")
        try:
            coverage = float(share) if share else 0.0
        except ValueError:
            coverage = -1.0
        if not 0.0 <= coverage <= 1.0:
            raise ValueError(f"{share[:60]!r} is not a share between 0 and 1; {REQUIREMENT_HINT}")
        return Requirement(grade=grade, coverage=coverage)


def valid_requirement(text: str) -> str:
    """Return a text that states a requirement. Raises `ValueError` for another text."""
    Requirement.from_text(text)
    return text
