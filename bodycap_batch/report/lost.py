"""The lost frames looked at: a picture and a likely cause for each stretch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.context import StageContext
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.losses import Cause, Loss, cause_of, find_losses
from bodycap_batch.report.packing import thinned
from bodycap_batch.report.pictures import Look, looks

_USUAL_FRAMES = 5
_LOOKS_EACH = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class LostFrame:
    """A stretch of lost frames with its picture and cause."""

    loss: Loss
    cause: Cause
    look: Look | None


def lost_frames(inputs: ReportInputs, context: StageContext) -> list[LostFrame]:
    """Every lost stretch with its cause; the longest ones of each camera are looked at."""
    losses = find_losses(inputs)
    out = []
    for name in inputs.cameras:
        mine = [loss for loss in losses if loss.camera == name]
        longest = sorted(mine, key=lambda loss: -loss.frames)[:_LOOKS_EACH]
        seen, usual = _looked_at(inputs, name, longest, context)
        out += [
            LostFrame(
                loss=loss,
                cause=cause_of(loss, seen.get(loss.middle), usual),
                look=seen.get(loss.middle),
            )
            for loss in mine
        ]
    return out


def _looked_at(
    inputs: ReportInputs, name: str, losses: Sequence[Loss], context: StageContext
) -> tuple[dict[int, Look], float | None]:
    """Looks at lost frames, and the corners usual in this camera's registered frames."""
    path = inputs.path(name)
    if not losses or path is None or inputs.capture is None:
        return {}, None
    kept = np.flatnonzero(path.localised)
    usual = [int(kept[index]) for index in thinned(len(kept), _USUAL_FRAMES)] if len(kept) else []
    seen = looks(inputs.capture.camera(name), [*(loss.middle for loss in losses), *usual], context)
    corners = [seen[index].corners for index in usual if index in seen]
    return seen, float(np.median(corners)) if corners else None


def causes_by_camera(lost: Sequence[LostFrame]) -> dict[str, Counter[Cause]]:
    """Lost frames by camera and cause."""
    out: dict[str, Counter[Cause]] = {}
    for each in lost:
        out.setdefault(each.loss.camera, Counter())[each.cause] += each.loss.frames
    return out
