"""Summarise the results of a job in a few lines: the verdict, its reasons, and what was measured."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import VERDICT_FILE, judge

_MAX_DOUBTS = 2
"""Maximum number of criteria that the summary names. The report lists all criteria. Evidence: none."""
_CENTRAL_PARTS = {"chest": "Spine1", "hips": "Hips", "head": "Head"}
"""Names of the middle parts of the body for the user, and the role of the joint that decides whether the part
was measured."""
_LIMB_PARTS = {"arm": ("Arm", "ForeArm"), "hand": ("Hand",), "leg": ("UpLeg", "Leg"), "foot": ("Foot",)}
"""The same for the parts of the limbs, which can have several such joints. The roles have no side here."""
_SEGMENTS = {"Arm": "upper arm", "ForeArm": "forearm", "UpLeg": "thigh", "Leg": "shin"}
"""Names of the two segments of an arm or a leg, for a limb of which only one segment was measured."""
_PLURALS = {"foot": "feet"}
"""Plurals of names that do not only get an s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultSummary:
    """The result of a job in short, for the end of a run, for lists of jobs and for other programs.

    Attributes:
        verdict: The content of ``verdict.json``.
        measured: Parts of the body that cameras measured.
        not_measured: Parts of the body that no camera measured.
    """

    verdict: Mapping[str, Any]
    measured: tuple[str, ...]
    not_measured: tuple[str, ...]

    @property
    def grade(self) -> Grade:
        """The worse of the grades of the cameras and the body."""
        return next(grade for grade in Grade if grade.word == self.verdict["grade"])

    @property
    def headline(self) -> str:
        """The verdict in some sentences, as on the report page."""
        return str(self.verdict["headline"])

    @property
    def coverage(self) -> float:
        """Share of what was recorded that is delivered: the smaller share of the frames and of the body."""
        coverage = self.verdict["coverage"] or {"share": 0.0, "body": None}
        return float(min(coverage["share"], (coverage["body"] or coverage)["share"]))

    @property
    def missing(self) -> str:
        """What is missing most, in words: the camera with the smallest share, or the body's motion."""
        coverage = self.verdict["coverage"] or {"share": 0.0, "cameras": {}, "body": None}
        body = coverage["body"]
        if body and body["share"] <= coverage["share"]:
            name, share = min(body["joints"].items(), key=lambda item: item[1], default=("", 0.0))
            return f"{name} was measured in {format_percent(share, 1)} of the motion"
        cameras = coverage["cameras"]
        if not cameras:
            return "no camera has a path"
        name = min(cameras, key=lambda each: float(cameras[each]["share"]))
        lost: Counter[str] = Counter()
        for span in cameras[name]["lost"]:
            lost[span["cause"]] += span["frames"]
        reason = cameras[name]["reason"] or next((cause for cause, _ in lost.most_common(1)), "")
        why = f": {reason}" if reason else ""
        return f"{name} has {format_percent(cameras[name]['share'], 1)} of its frames{why}"

    def criteria_worse_than(self, grade: Grade) -> list[Mapping[str, Any]]:
        """Return the criteria with a worse grade, as in ``verdict.json``, the worst first."""
        order = [each.word for each in Grade]
        parts = (self.verdict["cameras"], self.verdict["body"] or {"criteria": ()})
        found = [each for part in parts for each in part["criteria"] if order.index(each["grade"]) > grade]
        return sorted(found, key=lambda each: -order.index(each["grade"]))

    @property
    def doubts(self) -> tuple[str, ...]:
        """The worst criteria that are not good, at most two: grade, name and finding of each."""
        found = self.criteria_worse_than(Grade.GOOD)
        return tuple(f"{each['grade']}: {each['name']}: {each['finding']}" for each in found[:_MAX_DOUBTS])

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as plain JSON values."""
        return {
            "grade": self.grade.word,
            "coverage": self.coverage,
            "headline": self.headline,
            "doubts": list(self.doubts),
            "measured": list(self.measured),
            "not_measured": list(self.not_measured),
        }

    def lines(self) -> list[str]:
        """Return the summary as lines for the user."""
        lines = [f"verdict: {self.grade.word}. {self.headline}"]
        # The headline names some of the findings.
        lines += [f"  {doubt}" for doubt in self.doubts if doubt.split(": ", 2)[2][1:] not in self.headline]
        if self.measured:
            lines.append(f"measured: {', '.join(self.measured)}")
        if self.not_measured:
            lines.append(f"not measured: {', '.join(self.not_measured)}")
        return lines


def summarise(metrics: Mapping[str, Any], verdict: Mapping[str, Any] | None = None) -> ResultSummary:
    """Return the summary of results.

    Args:
        metrics: The content of ``metrics.json``.
        verdict: The content of ``verdict.json``; None to judge the results by their metrics alone.
    """
    measured, not_measured = measured_parts(metrics.get("motion", {}).get("joints", {}))
    found = judge(metrics, None).to_dict() if verdict is None else verdict
    return ResultSummary(verdict=found, measured=measured, not_measured=not_measured)


def summary_of_folder(folder: Path) -> ResultSummary | None:
    """Return the summary of a folder of results; None if the folder holds no metrics that can be read.

    Results without a verdict, of a report that failed or of an earlier version, are judged by their metrics.
    """
    try:
        metrics = json.loads((folder / "metrics.json").read_bytes())
        path = folder / VERDICT_FILE
        summary = summarise(metrics, json.loads(path.read_bytes()) if path.exists() else None)
        summary.to_dict()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration):
        return None
    return summary


def measured_parts(joints: Mapping[str, Mapping[str, Any]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the parts of the body that were measured, and of those that were not.

    Args:
        joints: The joints in ``metrics.json`` (``motion.joints``): role, and whether cameras measured it.
    """
    observed = {str(joint.get("role") or name): bool(joint.get("observed")) for name, joint in joints.items()}
    found: tuple[list[str], list[str]] = ([], [])
    for name, role in _CENTRAL_PARTS.items():
        if role in observed:
            found[not observed[role]].append(name)
    for part, roles in _LIMB_PARTS.items():
        for name, is_measured in _limb_names(part, roles, observed):
            found[not is_measured].append(name)
    return tuple(found[0]), tuple(found[1])


def _limb_names(
    part: str, roles: tuple[str, ...], observed: Mapping[str, bool]
) -> Iterator[tuple[str, bool]]:
    """Yield the names of a limb's parts, and whether each was measured. Equal sides have one name."""
    sides: dict[str, dict[str, bool]] = {}
    for side in ("Left", "Right"):
        states = {role: observed[side + role] for role in roles if side + role in observed}
        if states and len(set(states.values())) == 1:
            sides[side] = {part: next(iter(states.values()))}
        elif states:
            sides[side] = {_SEGMENTS[role]: state for role, state in states.items()}
    if len(sides) == 2 and sides["Left"] == sides["Right"]:
        yield from ((f"both {_plural(name)}", state) for name, state in sides["Left"].items())
        return
    for side, states in sides.items():
        yield from ((f"{side.lower()} {name}", state) for name, state in states.items())


def _plural(name: str) -> str:
    return _PLURALS.get(name, f"{name}s")
