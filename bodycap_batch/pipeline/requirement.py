"""Compare the verdict about a result with what the job requires."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.config.requirement import REQUIRED_GRADES, Requirement
from bodycap_batch.core.errors import RequirementUnmet
from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.summary import ResultSummary

_MAX_CAUSES = 3
"""Maximum number of criteria that the message names. The report lists all of them. Evidence: none."""


def unmet_requirement(text: str | None, summary: ResultSummary, out_dir: Path) -> RequirementUnmet | None:
    """Return the error about a result that does not reach what is required; None if it does.

    Args:
        text: The requirement of the job; None if the job has none.
        summary: The summary of the result.
        out_dir: Folder of the results.
    """
    if text is None:
        return None
    required = Requirement.from_text(text)
    grade = Grade(REQUIRED_GRADES.index(required.grade))
    causes = []
    if summary.grade > grade:
        found = [f"{each['name']} ({each['finding']})" for each in summary.criteria_worse_than(grade)]
        causes.append("; ".join(found[:_MAX_CAUSES]) or summary.headline)
    if summary.coverage < required.coverage:
        causes.append(summary.missing)
    if not causes:
        return None
    return RequirementUnmet(
        f"the result is {summary.grade.word} with {format_percent(summary.coverage, 1)} of the recording, "
        f"but {grade.word} with {format_percent(required.coverage, 1)} is required. The cause: "
        f"{'; '.join(causes)}",
        path=out_dir,
        hint="all results were written; the report says what to change next time",
    )
