"""What stands on the page, section by section; the templates only lay it out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bodycap_batch.report.advice import advise
from bodycap_batch.report.figures.body import before_and_after, before_optimisation
from bodycap_batch.report.figures.matrix import matrix
from bodycap_batch.report.figures.shared import shared
from bodycap_batch.report.figures.strips import COLUMNS, columns_at, strip
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.losses import Cause
from bodycap_batch.report.lost import LostFrame, causes_by_camera
from bodycap_batch.report.packing import Shown
from bodycap_batch.report.placing import Placed, common_times_s
from bodycap_batch.report.tables import headline_figures, tables_of
from bodycap_batch.report.verdict import judge

_SHEET = 24
_DONE = {
    "check": "no video was read",
    "keyframes": "the videos were opened, keyframes were being chosen",
    "map": "keyframes were chosen, the map could not be made",
    "registration": "the map was made, frames were being registered",
    "merge": "map and camera paths are done, the body could not be solved",
}


def page_content(
    inputs: ReportInputs, placed: Placed, lost: Sequence[LostFrame], tones: dict[str, str], shown: Shown
) -> dict[str, Any]:
    """Everything the templates need.

    Args:
        inputs: The results.
        placed: What is drawn in three dimensions.
        lost: Stretches of lost frames.
        tones: Colour of each camera.
        shown: How much was thinned.
    """
    verdict = judge(inputs.metrics, inputs.failure)
    return {
        "name": inputs.name,
        "verdict": verdict,
        "grades": Grade,
        "failure": inputs.failure,
        "came_to": _came_to(inputs),
        "figures": list(headline_figures(inputs.metrics)) if inputs.metrics is not None else [],
        "advice": advise(inputs, causes_by_camera(lost)),
        "tables": tables_of(inputs),
        "placed": placed,
        "has_solid": placed.drawn,
        "has_body": inputs.merge is not None,
        "cameras": _cameras(inputs, lost, tones, shown),
        "causes": {cause.value: words for cause, words in _CAUSES.items()},
        "sheet": _sheet(lost, shown.of(_SHEET)),
        "sheet_of": len(lost),
        "matrix": matrix(inputs, tones, shown.share),
        "shared": shared(inputs),
        "bodies": before_and_after(inputs, tones),
        "before": _before(inputs),
        "thinned": shown.lines(),
    }


_CAUSES = {
    Cause.DARK: "mean brightness of the lost frame below 30 of 255",
    Cause.FAST: "more than 8° of turn per frame beside the gap",
    Cause.BLUR: "sharpness below 60 % of the registered frames'",
    Cause.PLAIN: "under 30 % of the corners of the camera's registered frames",
    Cause.SHALLOW: "the points in view did not fix the position",
    Cause.UNKNOWN_PLACE: "sharp and textured, but not matched by the map",
    Cause.NO_MAP: "no map to register against",
}


def _came_to(inputs: ReportInputs) -> str:
    stage = str((inputs.failure or {}).get("stage", ""))
    return _DONE.get(stage, "")


def _cameras(
    inputs: ReportInputs, lost: Sequence[LostFrame], tones: dict[str, str], shown: Shown
) -> list[dict[str, Any]]:
    span = _span(inputs)
    causes = causes_by_camera(lost)
    used = set() if inputs.merge is None else {path.camera for path in inputs.merge.trajectories}
    out = []
    if shown.share < 1.0:
        shown.note("points of each curve over time", columns_at(shown.share), COLUMNS)
    for name in inputs.cameras:
        losses = [each.loss for each in lost if each.loss.camera == name]
        path = inputs.path(name)
        out.append(
            {
                "name": name,
                "tone": tones[name],
                "strip": strip(
                    inputs, name, span, losses, inputs.max_gap_s if name in used else 0.0, shown.share
                ),
                "frames": 0 if path is None else len(path.status),
                "registered": 0 if path is None else int(path.localised.sum()),
                "stretches": len(losses),
                "causes": [(cause.value, frames) for cause, frames in causes.get(name, {}).items()],
            }
        )
    return out


def _span(inputs: ReportInputs) -> tuple[float, float]:
    """First and last common time of all cameras."""
    ends: list[float] = []
    for name in inputs.cameras:
        path = inputs.path(name)
        if path is not None and len(path.times_ns):
            times = common_times_s(inputs, name, path.times_ns)
            ends += [float(times[0]), float(times[-1])]
        elif inputs.capture is not None:
            common = inputs.capture.camera(name).common_times_ns() * 1e-9
            ends += [float(common[0]), float(common[-1])] if len(common) else []
    return (min(ends), max(ends)) if ends else (0.0, 1.0)


def _sheet(lost: Sequence[LostFrame], most: int) -> list[dict[str, Any]]:
    """The longest losses with a picture, in the order they happened."""
    seen = sorted((each for each in lost if each.look is not None), key=lambda each: -each.loss.frames)
    chosen = sorted(seen[:most], key=lambda each: (each.loss.start_s, each.loss.camera))
    return [
        {
            "camera": each.loss.camera,
            "start": each.loss.start_s,
            "frames": each.loss.frames,
            "reason": each.loss.reason.value,
            "cause": each.cause.value,
            "facts": _facts(each),
            "picture": each.look.picture,
        }
        for each in chosen
        if each.look is not None
    ]


def _facts(each: LostFrame) -> str:
    parts = []
    if np.isfinite(each.loss.sharpness):
        parts.append(f"sharpness {each.loss.sharpness:.0%}")
    if np.isfinite(each.loss.turn_deg):
        parts.append(f"turn {each.loss.turn_deg:.0f}° a frame")
    if each.look is not None:
        parts.append(f"{each.look.corners} corners")
    return ", ".join(parts)


def _before(inputs: ReportInputs) -> list[dict[str, Any]]:
    """How far each camera alone would put its joint from where it was solved."""
    merge = inputs.merge
    if merge is None:
        return []
    rows = []
    world_from_joint = merge.motion.world_from_joint()
    for each in before_optimisation(inputs):
        off = each.off_m(world_from_joint)
        rows.append(
            {
                "camera": each.camera,
                "joint": merge.skeleton.joints[each.joint],
                "median": float(np.median(off)),
                "high": float(np.percentile(off, 95)),
            }
        )
    return rows
