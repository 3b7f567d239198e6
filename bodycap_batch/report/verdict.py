"""Judge the result of a job: the grade of what is delivered, and how much of the recording is delivered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import bodycap_batch
from bodycap_batch.report.coverage import Coverage, measure_coverage
from bodycap_batch.report.criteria import judge_criteria
from bodycap_batch.report.grades import Criterion, Grade
from bodycap_batch.report.loss_causes import LostSpan
from bodycap_batch.report.readings import (
    cameras_in_own_maps,
    main_cameras,
    read_rotation_only,
    unknown_clocks,
)

VERDICT_FILE = "verdict.json"
VERDICT_SCHEMA = 1
"""Version of the layout of ``verdict.json``. Another number means that a key was removed, or that it has
another meaning. Keys can be added at any time."""
_NAMED_SIGMAS = ("Metric scale", "Mounts")
"""Criteria that the headline names with their advice: their error is the same in all frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The judgement of a job's result.

    Attributes:
        judgement: The judgement of cameras and motion in one sentence, after those about unknown clocks.
        sigmas: Sentences about the scale and the mounts, if they are not good, with their advice.
        grade: The worse of the two grades `cameras` and `body`.
        cameras: Grade of the camera paths and the map.
        body: Grade of the body's motion; None if the job asks for no body.
        coverage: How much of the recording is delivered; None if the job has no metrics.
        criteria: All graded criteria.
    """

    judgement: str
    sigmas: tuple[str, ...]
    grade: Grade
    cameras: Grade
    body: Grade | None
    coverage: Coverage | None
    criteria: tuple[Criterion, ...]

    @property
    def headline(self) -> str:
        """The judgement in some sentences."""
        return " ".join((self.judgement, *self.sigmas))

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as plain JSON values, the content of ``verdict.json``."""

        def part(grade: Grade, subject: str) -> dict[str, Any]:
            criteria = [each.to_dict() for each in self.criteria if each.subject == subject]
            return {"grade": grade.word, "criteria": criteria}

        return {
            "schema_version": VERDICT_SCHEMA,
            "software_version": bodycap_batch.__version__,
            "grade": self.grade.word,
            "headline": self.headline,
            "coverage": None if self.coverage is None else self.coverage.to_dict(),
            "cameras": part(self.cameras, "cameras"),
            "body": None if self.body is None else part(self.body, "body"),
        }


def judge(
    metrics: Mapping[str, Any] | None, failure: Mapping[str, Any] | None, lost: Sequence[LostSpan] = ()
) -> Verdict:
    """Judge the result of a job by the job's own metrics.

    The grades are those of the delivered frames. Missing frames lower the coverage and no grade.

    Args:
        metrics: The content of ``metrics.json``; None if the job has no metrics.
        failure: The error that stopped the job; None if the job finished.
        lost: The lost spans of all cameras with their causes; empty if the pictures were not looked at.
    """
    criteria = () if metrics is None else tuple(judge_criteria(metrics))
    cameras, body = Grade.NONE, None
    if metrics is not None:
        if main_cameras(metrics) or read_rotation_only(metrics) is not None:
            cameras = _worst_grade(criteria, "cameras")
        if "merge" in metrics:
            body = _worst_grade(criteria, "body")
    if failure is not None and body is None:
        body = Grade.NONE
    coverage = None if metrics is None else measure_coverage(metrics, lost)
    return Verdict(
        judgement=_judgement(cameras, body, metrics, failure, coverage),
        sigmas=() if body is None or failure is not None else tuple(_named_sigmas(criteria)),
        grade=max(cameras, Grade.GOOD if body is None else body),
        cameras=cameras,
        body=body,
        coverage=coverage,
        criteria=criteria,
    )


def _worst_grade(criteria: Sequence[Criterion], subject: str) -> Grade:
    """Return the worst grade of a subject's criteria; the metrics of an old version may hold none of them."""
    return max((each.grade for each in criteria if each.subject == subject), default=Grade.GOOD)


def _judgement(
    cameras: Grade,
    body: Grade | None,
    metrics: Mapping[str, Any] | None,
    failure: Mapping[str, Any] | None,
    coverage: Coverage | None,
) -> str:
    if metrics is None or coverage is None:
        return "The job stopped before there was a result."
    phrases = ("are good", "are usable with care", "are poor", "have no path")
    left_out = _left_out(metrics, is_solved=failure is None and body is not None)
    first = f"{left_out}The cameras {phrases[cameras]} ({coverage.text})"
    if failure is not None:
        return f"{first}; the body could not be solved."
    if body is None:
        return f"{first}. The job asked for no body."
    conjunction = "and" if (body == Grade.GOOD) == (cameras == Grade.GOOD) else "but"
    phrases = ("is good", "is usable with care", "is poor", "is missing")
    return f"{first}, {conjunction} the motion {phrases[body]}."


def _named_sigmas(criteria: Sequence[Criterion]) -> Iterator[str]:
    """Yield a sentence about each uncertainty that the headline names."""
    for each in criteria:
        if each.name in _NAMED_SIGMAS and each.grade > Grade.GOOD:
            advice = each.advice
            action = "." if advice is None else f": {advice.action[:1].lower()}{advice.action[1:]}"
            yield f"{each.finding[:1].upper()}{each.finding[1:]}{action}"


def _left_out(metrics: Mapping[str, Any], *, is_solved: bool) -> str:
    """Return the sentences about cameras with an unknown clock; "" if there are none.

    Args:
        metrics: The content of ``metrics.json``.
        is_solved: True if there is a body, which is then solved without these cameras.
    """
    unknown, elsewhere = unknown_clocks(metrics), cameras_in_own_maps(metrics)
    sentences = []
    if names := [name for name in unknown if name not in elsewhere]:
        clocks, are = ("clock", "is") if len(names) == 1 else ("clocks", "are")
        sentences.append(
            f"The {clocks} of {' and '.join(names)} {are} unknown{_consequence(len(names), is_solved)}: clap "
            "once, or hop once, while all cameras record. "
        )
    if names := [name for name in unknown if name in elsewhere]:
        videos = "the video is" if len(names) == 1 else "the videos are"
        sentences.append(
            f"The map of {' and '.join(names)} has no place in common with the other cameras, and the clock "
            f"is unknown{_consequence(len(names), is_solved)}: check that {videos} of this recording, "
            "let all cameras see the same places, and clap once while they record. "
        )
    return "".join(sentences)


def _consequence(count: int, is_solved: bool) -> str:
    """Return what follows for the body from `count` cameras that are left out; "" without a body."""
    them = "it" if count == 1 else "them"
    return f", so the body is solved without {them}" if is_solved else ""
