"""Criteria about a body that does not fit: unusual postures, contradictory scales, cameras in odd places."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.grades import Criterion, Grade, grade_value
from bodycap_batch.report.metric_paths import metric_path

_GOOD_POSTURE_SIGMAS, _FAIR_POSTURE_SIGMAS = 0.33, 0.85
"""Maximum distance of the postures from the rest pose for the grades "good" and "usable with care".

Unit: sigmas of a joint's everyday range, as the root mean square over all joints. Evidence:
docs/decisions/report.md.
"""
_FAIR_MEAN_POSTURE_SIGMAS = 0.6
"""Maximum distance of the mean posture from the rest pose for the grade "usable with care".

Unit and evidence as for `_FAIR_POSTURE_SIGMAS`.
"""
_GOOD_SCALE_CHANCE, _FAIR_SCALE_CHANCE = 0.01, 0.0001
"""Minimum probability of a disagreement between scales for the grades "good" and "usable with care".

It is the probability that correct scales with the stated sigmas disagree as much by chance. Origin: one false
alarm in a hundred correct captures.
"""
_GOOD_MOUNT_TURN_DEG, _FAIR_MOUNT_TURN_DEG = 35.0, 60.0
"""Maximum angle (degrees) between a mount that was solved and the usual mount for the grades "good" and
"usable with care".

Derivation: with the expected error of `NOMINAL_ERROR_RAD` per axis, one mount in a thousand is turned by more
than 35°. Between two of the four rolls that are tried, the angle is 45°; with the expected error it is rarely
more than 60°.
"""
_LIMBS = {"Shoulder": "arm", "Arm": "arm", "ForeArm": "arm", "Hand": "arm", "Neck": "head", "Head": "head"}


def body_doubt_criteria(merge: Mapping[str, Any]) -> Iterator[Criterion]:
    """Yield the criteria that a wrong clock, place, scale or map violates.

    Args:
        merge: The value of ``merge`` in ``metrics.json``. Values that are missing yield no criterion.
    """
    yield from _posture_criteria(merge.get("posture_sigmas", {}), merge.get("mean_posture_sigmas", {}))
    scale = merge.get("scale", {})
    yield from _agreement_criteria(
        scale,
        "merge.scale.chi2",
        "Sources of the scale",
        " and ".join(source["name"] for source in scale.get("sources", ())),
    )
    limbs = scale.get("limbs") or {}
    yield from _agreement_criteria(
        limbs,
        "merge.scale.limbs.chi2",
        "Scales of the limbs",
        " and ".join(limb["name"] for limb in limbs.get("alone", ())),
    )
    yield from _mount_turn_criteria(merge.get("mounts", {}))


def _root_mean_square(values: Collection[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / max(1, len(values)))


def _posture_criteria(sigmas: Mapping[str, float], means: Mapping[str, float]) -> Iterator[Criterion]:
    """Yield the criterion about rare postures.

    Args:
        sigmas: By role of a joint, root mean square of its distance from the rest pose, in sigmas.
        means: By role of a joint, distance of its mean rotation from the rest pose, in sigmas.
    """
    if not sigmas:
        return
    overall, mean = _root_mean_square(sigmas.values()), _root_mean_square(means.values())
    grade = grade_value(overall, _GOOD_POSTURE_SIGMAS, _FAIR_POSTURE_SIGMAS)
    if mean > _FAIR_MEAN_POSTURE_SIGMAS:
        grade = Grade.POOR
    limbs: dict[str, list[float]] = {}
    for role, value in sigmas.items():
        side, part = split_side(role)
        limb = _LIMBS.get(part, "leg" if side else "trunk")
        limbs.setdefault(f"{side.lower()} {limb}".strip(), []).append(value**2)
    worst = max(limbs, key=lambda limb: (sum(limbs[limb]) / len(limbs[limb]), limb))
    yield Criterion(
        subject="body",
        name="Postures",
        grade=grade,
        finding=f"the joints are {overall:.2f} sigma of their everyday range from the rest pose"
        + (f" ({mean:.2f} in the mean over the capture)" if means else "")
        + f", most of all those of the {worst}",
        rationale="People who walk and reach out keep below 0.33, people who throw their arms about reach "
        "0.76 (0.5 in the mean over the capture). A wrong clock, a video with a cut, exchanged cameras, or a "
        "camera in another place than the job says needs rare postures: 0.35 to 1. The motion then looks "
        "possible, but it is wrong. This figure alone cannot distinguish thrown arms from a wrong clock.",
        value=overall,
    )


def _agreement_criteria(
    scales: Mapping[str, Any], metric: str, name: str, sources: str
) -> Iterator[Criterion]:
    """Yield the criterion about scales that should agree.

    Args:
        scales: Mapping with the entries ``chi2`` and ``degrees_of_freedom``.
        metric: Dotted path of the chi-square in ``metrics.json``.
        name: Name of the criterion.
        sources: Names of the scales.
    """
    freedom = int(scales.get("degrees_of_freedom") or 0)
    if freedom < 1:
        return
    from scipy.special import chdtrc  # scipy.stats takes a second to import.

    squares = float(scales["chi2"])
    chance = float(chdtrc(freedom, squares))
    yield Criterion(
        subject="body",
        name=name,
        grade=grade_value(chance, _GOOD_SCALE_CHANCE, _FAIR_SCALE_CHANCE, more_is_better=True),
        finding=f"the scales from {sources} {'agree' if chance >= _GOOD_SCALE_CHANCE else 'disagree'} "
        f"(chi-square {squares:.1f} with {freedom} {'degree' if freedom == 1 else 'degrees'} of freedom)",
        rationale="Each scale has a stated uncertainty. If correct scales disagree so much in less than one "
        "capture of a hundred, a bone length, a clock, the place of a camera or a part of the map is "
        "wrong.",
        metric=metric,
        value=squares,
    )


def _mount_turn_criteria(mounts: Mapping[str, Any]) -> Iterator[Criterion]:
    """Yield the criterion about mounts far from the usual mount, if the job does not give their rotation."""
    turns = {
        name: float(mount["from_usual_deg"])
        for name, mount in mounts.items()
        if mount.get("from_usual_deg") is not None
    }
    worst = max(turns, key=lambda name: turns[name], default=None)
    if worst is None:
        return
    yield Criterion(
        subject="body",
        name="Cameras in their usual places",
        grade=grade_value(turns[worst], _GOOD_MOUNT_TURN_DEG, _FAIR_MOUNT_TURN_DEG),
        finding=f"camera {worst} is turned by {turns[worst]:.0f}° from the usual mount on "
        f"{mounts[worst]['role']}",
        rationale="One camera in a thousand is strapped on more than 35° away from the usual mount or a "
        "quarter turn of it. More often the camera is on another part of the body than the job says, or its "
        "clock is wrong.",
        metric=metric_path("merge", "mounts", worst, "from_usual_deg"),
        value=turns[worst],
    )
