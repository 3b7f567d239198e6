"""Summarise the results of a job in a few lines: the verdict, its reasons, and what was measured."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import judge

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
        grade: The worse of the grades of the cameras and the body.
        headline: The verdict in one sentence, as on the report page.
        doubts: The worst criteria that are not good, at most two: grade, name and finding of each.
        measured: Parts of the body that cameras measured.
        not_measured: Parts of the body that no camera measured.
    """

    grade: Grade
    headline: str
    doubts: tuple[str, ...]
    measured: tuple[str, ...]
    not_measured: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as plain JSON values."""
        return {
            "grade": self.grade.word,
            "headline": self.headline,
            "doubts": list(self.doubts),
            "measured": list(self.measured),
            "not_measured": list(self.not_measured),
        }

    def lines(self) -> list[str]:
        """Return the summary as lines for the user."""
        lines = [f"verdict: {self.grade.word}. {self.headline}"]
        lines += [f"  {doubt}" for doubt in self.doubts]
        if self.measured:
            lines.append(f"measured: {', '.join(self.measured)}")
        if self.not_measured:
            lines.append(f"not measured: {', '.join(self.not_measured)}")
        return lines


def summarise(metrics: Mapping[str, Any]) -> ResultSummary:
    """Return the summary of the results with these metrics (the content of ``metrics.json``)."""
    verdict = judge(metrics, None)
    doubts = sorted((each for each in verdict.criteria if each.grade > Grade.GOOD), key=lambda c: -c.grade)
    joints = metrics.get("motion", {}).get("joints", {})
    measured, not_measured = measured_parts(joints)
    return ResultSummary(
        grade=verdict.grade,
        headline=verdict.headline,
        doubts=tuple(f"{each.grade.word}: {each.name}: {each.finding}" for each in doubts[:_MAX_DOUBTS]),
        measured=measured,
        not_measured=not_measured,
    )


def summary_of_folder(folder: Path) -> ResultSummary | None:
    """Return the summary of a folder of results; None if the folder holds no metrics that can be read."""
    try:
        return summarise(json.loads((folder / "metrics.json").read_bytes()))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


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
